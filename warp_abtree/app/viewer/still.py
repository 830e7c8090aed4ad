"""The viewer for scenes made in Python."""

from warp_abtree.app.playback import StillPlayback
from warp_abtree.app.viewer.command import HOST, check_port, import_viser, show
from warp_abtree.scene.scene import Scene


def view(scene: Scene, title="scene", host=HOST, port=None, seconds=None):
    """Show a scene in the browser, as it stands: print the address, and serve until Ctrl-C.

    The page sets LODs, which are those of before at the end; poses stay. Waits for the device.

    Args:
        scene: `Scene` with objects.
        title: What the page is called.
        host, port: Where to serve: this machine alone at 8080, or the next port that is free.
        seconds: How long [s]; None is until Ctrl-C.

    Raises:
        TypeError: scene is no Scene.
        ValueError: viser is not installed, the scene has no object, or the address cannot be served at.
    """
    if not isinstance(scene, Scene):
        raise TypeError(f"scene is a {type(scene).__name__}, not a Scene")
    import_viser()
    check_port(host, 0 if port is None else port)
    lods = scene.lods
    try:
        show(StillPlayback(scene, title), host, port, seconds=seconds)
    finally:
        if scene.object_count:
            scene.set_lods(lods)

"""The viewer: `warp-abtree view` of a scene or meshes, and `view` of a scene made in Python."""

import contextlib
import gc
import io
import json
import logging
import socket

from warp_abtree.app.cli.arguments import Parser, milliseconds
from warp_abtree.app.playback import OWN_MODE, Playback, StillPlayback, add_playback_arguments, open_playback
from warp_abtree.app.toml.control import BUDGET_CONTROLLERS
from warp_abtree.app.viewer.guard import refuse_foreign
from warp_abtree.scene.scene import Scene

HOST, PORT = "127.0.0.1", 8080
SUMMARY = "look at a scene or meshes in the browser"
EXAMPLES = (
    "scenes/bunny_tori.toml",
    "warp:bunny warp:bunny --pose 0.3 0 0 0 0 0 1",
    "scenes/focus.toml --objects 500 --budget 20ms",
)


def add_arguments(sub: Parser):
    """Add the arguments of the command to its parser."""
    add_playback_arguments(sub)
    sub.add_argument("--budget", type=milliseconds, metavar="TIME", help="time of a frame to hold, as 8ms or 0.008s")
    sub.add_argument("--host", default=HOST, help="address to serve at (127.0.0.1, this machine alone)")
    sub.add_argument("--port", type=int, metavar="P", help=f"port to serve at ({PORT}, or the next one that is free)")


def import_viser(asked="view"):
    """Return viser, silent; raise ValueError where it is not installed, with what was asked."""
    try:
        import viser
    except ImportError as error:
        raise ValueError(f"{asked} needs viser: pip install viser ({error})") from None
    # A browser that goes away in the middle of a message is no news.
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
    return viser


def check_port(host, port):
    """Raise ValueError for no address, no port, or one that another program has."""
    if not 0 <= port <= 65535:
        raise ValueError(f"--port: {port} is outside 0 .. 65535")
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        with socket.socket(found[0], found[1]) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(found[4])
    except OSError as error:
        raise ValueError(f"{host}:{port}: cannot be served at ({error.strerror or error})") from None


@contextlib.contextmanager
def serve(host="127.0.0.1", port=0):
    """Give a viser server that refuses pages of others, stopped with its threads at the end."""
    viser = import_viser()
    # The server prints where it is and that it stops; the command says that itself.
    with contextlib.redirect_stdout(io.StringIO()), refuse_foreign(host):
        server = viser.ViserServer(host=host, port=port, verbose=False)
    try:
        yield server
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()


def run_viewer(options, progress):
    """Serve a page until Ctrl-C."""
    import_viser()
    if options.port is not None or options.host != HOST:
        check_port(options.host, 0 if options.port is None else options.port)
    playback = open_playback(options.source, options.device, progress, options.objects, options.pose, options.lod)
    if options.budget is not None:
        has_own = playback.control.controller in BUDGET_CONTROLLERS
        playback.choose(OWN_MODE if has_own else "predictive", options.budget)
    progress.close()
    gc.collect()
    gc.freeze()
    show(playback, options.host, options.port, options.json)


def show(playback: Playback, host=HOST, port=None, as_json=False, seconds=None):
    """Serve a page about a playback until Ctrl-C, or for a time [s]; print its address, or raise ValueError."""
    from warp_abtree.app.viewer.page import Page

    with serve(host, PORT if port is None else port) as server:
        if port and server.get_port() != port:
            raise ValueError(f"{host}:{port}: cannot be served at")
        page = Page(server, playback)
        shown = "localhost" if host in (HOST, "0.0.0.0", "::") else f"[{host}]" if ":" in host else host
        address = f"http://{shown}:{server.get_port()}"
        found = {"address": address, "title": playback.title, "objects": playback.scene.object_count}
        with contextlib.suppress(KeyboardInterrupt):  # from when the address is told
            print(json.dumps(found) if as_json else f"{playback.title}: {address} (Ctrl-C ends)", flush=True)
            page.run(seconds)


def view(scene: Scene, title="scene", host=HOST, port=None, seconds=None, up="z"):
    """Show a scene in the browser, as it stands: print the address, and serve until Ctrl-C.

    The page sets LODs, which are those of before at the end; poses stay. Waits for the device.

    Args:
        scene: `Scene` with objects.
        title: What the page is called.
        host, port: Where to serve: this machine alone at 8080, or the next port that is free.
        seconds: How long [s]; None is until Ctrl-C.
        up: Axis that points upwards, as "z" or "-y", or a direction, (3,).

    Raises:
        TypeError: scene is no Scene.
        ValueError: viser is not installed, the scene has no object, up is no direction, or the address cannot be
            served at.
    """
    import_viser()
    check_port(host, 0 if port is None else port)
    playback = StillPlayback(scene, title, up)
    try:
        show(playback, host, port, seconds=seconds)
    finally:
        scene.set_lods(playback.started)

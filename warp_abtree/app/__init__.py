"""Applications of the library: scene files, pictures, the viewer and the command line."""

from warp_abtree.app.pictures.scenes import picture
from warp_abtree.app.toml.errors import SceneError
from warp_abtree.app.toml.scene_file import SceneFile, load_scene
from warp_abtree.app.viewer.command import view

__all__ = ["SceneError", "SceneFile", "load_scene", "picture", "view"]

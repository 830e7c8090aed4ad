"""Applications of the library; nothing below imports them."""

from warp_abtree.app.pictures.picture import draw_objects
from warp_abtree.app.pictures.plot import draw_controllers
from warp_abtree.app.toml.scene_file import SceneError, load_scene

__all__ = ["SceneError", "draw_controllers", "draw_objects", "load_scene"]

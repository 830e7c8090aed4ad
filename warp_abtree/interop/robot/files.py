"""`Description` of the files of a robot, whatever their format."""

from pathlib import Path

from warp_abtree.checks.arguments import first_line
from warp_abtree.interop.robot.description import Description, RobotError
from warp_abtree.interop.robot.mjcf import read_mjcf
from warp_abtree.interop.robot.urdf import apply_srdf, read_urdf

ENDINGS = {".urdf": read_urdf, ".xml": read_mjcf, ".mjcf": read_mjcf}


def read_robot(path: Path, geometry: str, srdf: Path | None, strict: bool) -> Description:
    """Read the files of a robot; see `Robot.load`."""
    if path.suffix.lower() not in ENDINGS:
        raise RobotError(f"{path}: a robot is a .urdf or .xml file")
    if geometry not in ("collision", "visual"):
        raise ValueError(f"geometry {geometry!r} is neither 'collision' nor 'visual'")
    for file in (path, *([] if srdf is None else [srdf])):
        if not file.is_file():
            raise RobotError(f"{file}: no such file")
    try:
        description = ENDINGS[path.suffix.lower()](path, geometry)
    except UnicodeDecodeError as error:  # of MuJoCo's names
        raise RobotError(f"{path}: a name is not in UTF-8 ({first_line(error)})") from None
    if not description.parts:
        other = "visual" if geometry == "collision" else "collision"
        raise RobotError(f"{path}: no link has a mesh of geometry={geometry!r}; it may have some of {other!r}")
    if srdf is not None:
        apply_srdf(description, srdf, strict)
    return description

"""Bridge to the top-level kernels folder of a checkout; an installed package holds the kernels themselves."""

from pathlib import Path

_root = Path(__file__).resolve().parents[2]
if (_root / "pyproject.toml").is_file() and (_root / "kernels").is_dir():
    __path__ = [str(_root / "kernels")]

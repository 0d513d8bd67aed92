"""Where model files are: pybullet_data's and our own, found without importing the simulator."""

from __future__ import annotations

import functools
import importlib.util
from pathlib import Path

from demorec.errors import MissingDependencyError, SceneError

OWN_PREFIX = "demorec:"


@functools.cache
def data_folder() -> Path:
    """The folder of pybullet_data; MissingDependencyError when it is not installed."""
    spec = importlib.util.find_spec("pybullet_data")
    if spec is None or spec.origin is None:
        raise MissingDependencyError("Loading robot models", "pybullet", "pip install pybullet")
    return Path(spec.origin).parent


def asset_path(name: str) -> Path:
    """Absolute path of "demorec:NAME" (a file of `demorec/sim/assets`) or of a path below pybullet_data.

    Raises:
        SceneError: There is no such file.
    """
    if name.startswith(OWN_PREFIX):
        path = Path(__file__).parent / "sim" / "assets" / name.removeprefix(OWN_PREFIX)
    else:
        path = data_folder() / name
    if not path.is_file():
        raise SceneError(f"The model file {name!r} was not found: give a path below pybullet_data, or demorec:NAME.")
    return path


def mesh_path(folder: Path, name: str) -> Path:
    """Absolute path of a mesh that a URDF in `folder` names: beside it, or below pybullet_data for our own URDFs.

    Raises:
        SceneError: There is no such file.
    """
    relative = name.removeprefix("package://").removeprefix("file://")
    for candidate in (folder / relative, folder.parent / relative, data_folder() / relative):
        if candidate.is_file():
            return candidate
    raise SceneError(f"The mesh {name!r} is neither beside its URDF nor in pybullet_data: {folder}")

"""URDFs of our own and of the user's, with meshes of pybullet_data: PyBullet looks for meshes beside the URDF only."""

from __future__ import annotations

import functools
import os
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from demorec.scene.assets import asset_path, mesh_path


@contextmanager
def urdf_file(name: str) -> Iterator[str]:
    """A file that PyBullet can load while the context lasts.

    Args:
        name: As in `demorec.scene.assets.asset_path`.

    Raises:
        SceneError: The URDF or one of its meshes is missing.
    """
    path = asset_path(name)
    if ":" not in name:  # of pybullet_data, meshes beside it
        yield str(path)
        return
    descriptor, copy = tempfile.mkstemp(suffix=".urdf", prefix="demorec_")
    try:
        with os.fdopen(descriptor, "w") as file:
            file.write(_with_absolute_meshes(path))
        yield copy
    finally:
        Path(copy).unlink()


@functools.cache
def _with_absolute_meshes(path: Path) -> str:
    return re.sub(
        r'(<mesh\s+filename=")([^"]+)"',
        lambda match: f'{match.group(1)}{mesh_path(path.parent, match.group(2))}"',
        path.read_text(),
    )

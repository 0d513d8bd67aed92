"""URDFs into PyBullet, which looks for meshes beside the URDF only: ours and the user's name those of pybullet_data."""

from __future__ import annotations

import functools
import os
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from demorec.errors import DemorecError, SceneError
from demorec.geometry import Pose
from demorec.scene.assets import asset_path, mesh_path


def load_urdf(client: Any, name: str, pose: Pose, *, scale: float, is_fixed: bool, what: str) -> int:
    """Load a URDF and return its PyBullet index.

    Args:
        client: The PyBullet client.
        name: As in `demorec.scene.assets.asset_path`.
        pose: Of its base.
        scale: Uniform scale.
        is_fixed: Whether physics cannot move its base.
        what: Whose model it is, for messages ("body 'duck'").

    Raises:
        SceneError: The URDF or one of its meshes is missing or cannot be loaded.
    """
    try:
        with urdf_file(name) as path:
            place = pose.position.tolist(), pose.quat_xyzw.tolist()
            return int(client.loadURDF(path, *place, useFixedBase=is_fixed, globalScaling=scale))
    except DemorecError:
        raise
    except Exception as error:  # PyBullet raises its own bare pybullet.error
        raise SceneError(f"The {what} cannot be loaded from {name!r} ({error}).") from error


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

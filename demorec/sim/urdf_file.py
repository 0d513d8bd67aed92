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

from demorec.core.errors import DemorecError, SceneError
from demorec.core.geometry import Pose
from demorec.robots.assets import asset_path, mesh_path
from demorec.robots.inertials import check_masses, with_massless_frames
from demorec.sim.client import silence


def load_urdf(
    client: Any, name: str, pose: Pose, *, scale: float, is_fixed: bool, what: str, is_robot: bool = False
) -> int:
    """Load a URDF and return its PyBullet index.

    Args:
        client: The PyBullet client.
        name: As in `demorec.robots.assets.asset_path`.
        pose: Of its base.
        scale: Uniform scale.
        is_fixed: Whether physics cannot move its base.
        what: Whose model it is, for messages ("body 'duck'").
        is_robot: Whether each link has to say what it weighs, and a frame weighs nothing.

    Raises:
        ConfigError: A link of a robot does not say what it weighs.
        SceneError: The URDF or one of its meshes is missing or cannot be loaded.
    """
    if is_robot:
        check_masses(name)
    try:
        with urdf_file(name, has_frames=is_robot) as path, silence():
            place = pose.position.tolist(), pose.quat_xyzw.tolist()
            return int(client.loadURDF(path, *place, useFixedBase=is_fixed, globalScaling=scale))
    except DemorecError:
        raise
    except Exception as error:  # PyBullet raises its own bare pybullet.error
        raise SceneError(f"The {what} cannot be loaded from {name!r} ({error}).") from error


@contextmanager
def urdf_file(name: str, *, has_frames: bool = False) -> Iterator[str]:
    """A file that PyBullet can load while the context lasts.

    Args:
        name: As in `demorec.robots.assets.asset_path`.
        has_frames: Whether links without `<inertial>` are frames of no mass.

    Raises:
        SceneError: The URDF or one of its meshes is missing.
    """
    path = asset_path(name)
    text = path.read_text()
    loaded = with_massless_frames(text) if has_frames else text
    if ":" not in name and loaded == text:  # of pybullet_data, meshes beside it
        yield str(path)
        return
    descriptor, copy = tempfile.mkstemp(suffix=".urdf", prefix="demorec_")
    try:
        with os.fdopen(descriptor, "w") as file:
            file.write(_with_absolute_meshes(loaded, path.parent))
        yield copy
    finally:
        Path(copy).unlink()


@functools.cache
def _with_absolute_meshes(text: str, folder: Path) -> str:
    return re.sub(
        r'(<mesh\s+filename=")([^"]+)"', lambda match: f'{match.group(1)}{mesh_path(folder, match.group(2))}"', text
    )

"""Descriptions of imported episodes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import cache
from importlib.metadata import version
from pathlib import Path

import numpy as np
from numpy.typing import DTypeLike

from demorec.core.errors import ConfigError
from demorec.core.files import read_text_limited
from demorec.episode.features import STATE
from demorec.episode.info import Camera, EpisodeInfo, Feature, Origin, SourceFile
from demorec.extensions.imports.fields import FieldError
from demorec.extensions.imports.mapping import SourceMapping
from demorec.robots.assets import remember_model
from demorec.robots.urdf import MAX_BYTES, Urdf


@cache
def importing_versions() -> Mapping[str, str]:
    """Return the versions of the packages that read and write an episode, for its recording."""
    return {name: version(name) for name in ("demorec", "av")}


def imported_feature(
    name: str, dtype: DTypeLike, names: tuple[str, ...], units: Iterable[str], *, called: Iterable[str], source: str
) -> Feature:
    """Describe a feature in recordings' form; `called` has the names of the joints to which its elements may belong."""
    units = tuple("deg" if unit == "degree" else unit for unit in units)
    return Feature(
        name=name,
        dtype="float32" if dtype == np.float32 else "float64",
        names=names,
        units=units if any(units) else (),
        joints=tuple(called) if name == STATE else (),
        source=source,
    )


def imported_info(
    mapping: SourceMapping,
    *,
    episode_index: int,
    instruction: str,
    urdf: str | None,
    fps: int,
    features: Iterable[Feature],
    cameras: Iterable[Camera],
    files: Iterable[SourceFile],
) -> EpisodeInfo:
    """Describe an episode that was imported by a mapping; FieldError if the robot's model is not a URDF."""
    try:
        joints = set() if urdf is None else {joint.name for joint in Urdf.parse(urdf).joints}
    except ValueError as error:
        raise FieldError(f"the robot's model cannot be used ({error})") from error

    def moved(feature: Feature) -> Feature:
        names = tuple(name if name in joints else "" for name in feature.joints)
        return replace(feature, joints=names if any(names) else ())

    return EpisodeInfo(
        episode_index=episode_index,
        instruction=" ".join(instruction.split()),
        robot_name=mapping.robot.name,
        urdf=urdf or "",
        fps=fps,
        features=tuple(map(moved, features)),
        cameras=tuple(cameras),
        origin=Origin(kind="import", files=tuple(files), mapping_digest=mapping.digest),
        versions=importing_versions(),
    )


def urdf_text(mapping: SourceMapping, mapping_path: Path) -> str | None:
    """Read the URDF file that a mapping names; None if it names none. Raises ConfigError if it cannot be read."""
    if not mapping.robot.urdf:
        return None
    path = mapping_path.parent / mapping.robot.urdf
    try:
        text = read_text_limited(path, MAX_BYTES)
        remember_model(text, path)
        return text or None
    except (OSError, ValueError) as error:  # not text, or a NUL in the name
        raise ConfigError(
            f"The URDF cannot be read ({getattr(error, 'strerror', 'it is not text')}): {path}"
        ) from error

"""What an episode's recording says about it before its first frame: its features, cameras, robot and origin."""

from __future__ import annotations

from collections.abc import Container, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from demorec.core.errors import ConfigError
from demorec.core.files import read_text_limited
from demorec.episode.external import Camera, Feature
from demorec.sources.bag import Bag
from demorec.sources.channel import BagError
from demorec.sources.episode_writer import PicturePlan
from demorec.sources.mapping_file import STATE, recorded_unit
from demorec.sources.rows import FeatureRows, Timelines
from demorec.sources.streams import BagStreams

_MAX_URDF_BYTES = 4 << 20


def urdf_text(name: str, mapping_path: Path) -> str:
    """The URDF that a mapping names a file for; "" when it names none. ConfigError when it cannot be read."""
    if not name:
        return ""
    path = mapping_path.parent / name
    try:
        return read_text_limited(path, _MAX_URDF_BYTES)
    except (OSError, ValueError) as error:  # no text, or NUL in the name
        raise ConfigError(f"The URDF cannot be read ({getattr(error, 'strerror', 'it is no text')}): {path}") from error


def urdf_in_bag(bag: Bag, streams: BagStreams, topic: str) -> str:
    """The URDF that a topic of the bag holds; BagError when it holds none."""
    text = streams.texts[topic][0].value if streams.texts[topic] else ""
    if not isinstance(text, str) or not text.strip():
        raise BagError(f"{topic} holds no robot description: {bag.path}")
    return text


def described_feature(name: str, feature: FeatureRows, lines: Timelines, joints: Container[str]) -> Feature:
    """A feature as recordings know it, given the joints of the robot's model."""
    units = tuple(map(recorded_unit, feature.units))
    sources = lines.mapping.features[name]
    told = []
    for index, source in enumerate(sources):
        if source.next:
            told.append(f"{source.next} of the next frame")
            continue
        clock = "header" if lines.lines[name, index].is_header else "log"
        told.append(f"{source.topic} {source.field}, {lines.rule((name, index))[0]} by {clock} time")
    moves = [element if element in joints and name == STATE else "" for element in feature.names]
    return Feature(
        name=name,
        dtype="float32" if feature.values.dtype == np.float32 else "float64",
        names=feature.names,
        units=units if any(units) else (),
        joints=tuple(moves) if any(moves) else (),
        source="; ".join(told),
    )


def described_camera(name: str, plan: PicturePlan, lines: Timelines) -> Camera:
    """A camera as recordings know it."""
    clock = "header" if lines.lines[name].is_header else "log"
    info = lines.streams.infos.get(name, {})
    matrix, distortion = _first(info, "k", "K"), _first(info, "d", "D")
    size = (plan.head.width, plan.head.height)
    fits = (info.get("width") or size[0], info.get("height") or size[1]) == size
    known = fits and len(matrix) == 9 and matrix[0] > 0 and bool(np.isfinite(matrix).all())
    return Camera(
        name=name,
        width=plan.head.width,
        height=plan.head.height,
        kept=plan.kept,
        intrinsics=tuple(matrix) if known else None,
        distortion=tuple(distortion) if known and len(distortion) == 5 and np.isfinite(distortion).all() else (),
        source=f"{plan.topic}, {lines.rule(name)[0]} by {clock} time",
    )


def _first(values: Mapping[str, Any], *keys: str) -> list[float]:
    """The numbers of the first of these fields that is there."""
    found = next((values[key] for key in keys if key in values), None)
    return [float(number) for number in found.reshape(-1)] if isinstance(found, np.ndarray) and found.size <= 64 else []

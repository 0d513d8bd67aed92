"""What an episode's recording says about it before its first frame: its features, cameras, robot and origin."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from demorec.errors import ConfigError
from demorec.ingest.bag import Bag
from demorec.ingest.channel import BagError
from demorec.ingest.episode_writer import PicturePlan
from demorec.ingest.mapping_file import STATE, recorded_unit
from demorec.ingest.rows import EpisodeRows, FeatureRows, Timelines
from demorec.ingest.streams import BagStreams
from demorec.safety.files import read_text_limited
from demorec.scene.collected import CollectedCamera, CollectedFeature, CollectedInfo, Origin, SourceFile
from demorec.scene.urdf import Urdf

_MAX_URDF_BYTES = 4 << 20


def urdf_text(name: str, mapping_path: Path) -> str:
    """The URDF that a mapping names a file for; "" when it names none. ConfigError when it cannot be read."""
    if not name:
        return ""
    path = mapping_path.parent / name
    try:
        return read_text_limited(path, _MAX_URDF_BYTES)
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"The URDF cannot be read ({getattr(error, 'strerror', 'it is no text')}): {path}") from error


def describe(
    *,
    bag: Bag,
    lines: Timelines,
    rows: EpisodeRows,
    plans: Mapping[str, PicturePlan],
    urdf: str,
    episode_index: int,
    instruction: str,
    files: Mapping[str, str],
) -> CollectedInfo:
    """The description of an episode; `files` by name -> SHA-256. BagError when the robot's model in the bag is none."""
    mapping = lines.mapping
    sources = tuple(SourceFile(name=name, sha256=sha256) for name, sha256 in files.items())
    if mapping.robot.urdf_topic:
        urdf = _urdf_of(bag, lines.streams, mapping.robot.urdf_topic)
    joints = frozenset[str]()
    if urdf:
        try:
            joints = frozenset(joint.name for joint in Urdf.parse(urdf).joints)
        except ValueError as error:
            raise BagError(f"The robot's model cannot be used ({error}): {bag.path}") from error
    return CollectedInfo(
        episode_index=episode_index,
        instruction=" ".join(instruction.split()),
        robot=mapping.robot.name,
        urdf=urdf,
        fps=mapping.clock.fps,
        features=tuple(_feature(name, feature, lines, joints) for name, feature in rows.features.items()),
        cameras=tuple(_camera(name, plan, lines) for name, plan in plans.items()),
        origin=Origin(kind="import", files=sources, mapping_digest=mapping.digest),
        versions={"demorec": version("demorec"), "av": version("av")},
    )


def _urdf_of(bag: Bag, streams: BagStreams, topic: str) -> str:
    text = streams.texts[topic][0].value if streams.texts[topic] else ""
    if not isinstance(text, str) or not text.strip():
        raise BagError(f"{topic} holds no robot description: {bag.path}")
    return text


def _feature(name: str, feature: FeatureRows, lines: Timelines, joints: frozenset[str]) -> CollectedFeature:
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
    return CollectedFeature(
        name=name,
        dtype="float32" if feature.values.dtype == np.float32 else "float64",
        names=feature.names,
        units=units if any(units) else (),
        joints=tuple(moves) if any(moves) else (),
        source="; ".join(told),
    )


def _camera(name: str, plan: PicturePlan, lines: Timelines) -> CollectedCamera:
    clock = "header" if lines.lines[name].is_header else "log"
    info = lines.streams.infos.get(name, {})
    matrix, distortion = _first(info, "k", "K"), _first(info, "d", "D")
    fits = (int(info.get("width") or plan.head.width), int(info.get("height") or plan.head.height)) == (
        plan.head.width,
        plan.head.height,
    )
    known = fits and len(matrix) == 9 and matrix[0] > 0 and bool(np.isfinite(matrix).all())
    return CollectedCamera(
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
    found = next((values[key] for key in keys if key in values), ())
    return [float(number) for number in np.asarray(found, dtype=np.float64).reshape(-1)]

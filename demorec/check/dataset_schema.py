"""Is what info.json says of a dataset's columns, videos, splits and robot what its files, and its sidecar, hold."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pyarrow as pa

from demorec.check.base import Measurement, dataset_check, sidecar_check
from demorec.check.dataset import Dataset
from demorec.core.errors import ExportError, describe_error
from demorec.core.tables import ROBOTS
from demorec.datasets.lerobot.files import open_table, read_json
from demorec.datasets.lerobot.layout import AUTOMATIC_FEATURES, DatasetFeature
from demorec.datasets.lerobot.mp4_index import check_video
from demorec.datasets.lerobot.paths import INFO_PATH
from demorec.datasets.lerobot.robots import ELEMENT_SUFFIX
from demorec.episode.features import ACTION, ENVIRONMENT_STATE, IMAGE_PREFIX, STATE, observation_names
from demorec.episode.info import EpisodeInfo

_TYPES = {
    "float32": pa.float32(), "float64": pa.float64(), "int64": pa.int64(), "bool": pa.bool_(), "string": pa.string(),
}  # fmt: skip
_CHANNELS, _CHANNEL_COUNTS = ("channel", "channels"), (1, 3, 4)
_RATE_TOLERANCE = 0.01
"""Files that were put together have rates that are a little off."""


@dataset_check(
    measures="statements of info.json that its tables and videos contradict",
)
def dataset_schema(dataset: Dataset) -> Measurement:
    """Columns, types, shapes, names; codec, size and rate of each video file; splits that cover all episodes."""
    wrong = [*_columns(dataset), *_names(dataset), *_videos(dataset), *_splits(dataset)]
    found = f"{len(dataset.info.features)} features"
    return Measurement(value=len(wrong), detail="; ".join(wrong[:3]) or found)


def _columns(dataset: Dataset) -> Iterator[str]:
    """Of the data files, against the features; and of the counters, against what they always are."""
    features = {name: feature for name, feature in dataset.info.features.items() if not feature.is_video}
    for name, fixed in AUTOMATIC_FEATURES.items():
        found = features.get(name)
        if found is None or (found.dtype, found.shape) != (fixed.dtype, fixed.shape):
            yield f"{name} is no {fixed.dtype} of shape {fixed.shape}"
    for path in sorted((dataset.path / "data").glob("*/*.parquet")):
        schema = open_table(path).schema_arrow
        columns = set(schema.names)
        yield from (f"{path.name} has no column {name}" for name in features if name not in columns)
        yield from (f"{path.name} has a column {name}, which is no feature" for name in columns if name not in features)
        for name in features:
            if name in columns and not _fits(schema.field(name).type, features[name]):
                yield f"{name} is {schema.field(name).type} in {path.name}, {features[name].dtype} in info.json"


def _fits(found: pa.DataType, feature: DatasetFeature) -> bool:
    if feature.dtype not in _TYPES:
        return True  # images in tables, which other writers have
    size = None
    while pa.types.is_list(found) or pa.types.is_fixed_size_list(found) or pa.types.is_large_list(found):
        if pa.types.is_fixed_size_list(found):
            size = (size or 1) * found.list_size
        found = found.value_type
    if size is not None and size != math.prod(feature.shape):
        return False
    return bool(found == _TYPES[feature.dtype] or (feature.dtype == "string" and pa.types.is_large_string(found)))


def _names(dataset: Dataset) -> Iterator[str]:
    for name, feature in dataset.info.features.items():
        for place, told in enumerate(feature.names or ()) if len(feature.shape) == 3 else ():
            if told in _CHANNELS and place < 3 and feature.shape[place] not in _CHANNEL_COUNTS:
                yield f"{name} has {feature.shape[place]} {told} by its names"
        if feature.names is None or len(feature.shape) != 1:
            continue
        if len(feature.names) != feature.shape[0]:
            yield f"{name} has {len(feature.names)} names for {feature.shape[0]} components"
        if len(set(feature.names)) != len(feature.names):
            yield f"{name} names a component twice"
    state = dataset.info.features.get(STATE)
    joints = [ELEMENT_SUFFIX.sub("", name) for name in state.names or ()] if state is not None else []
    robot = dataset.info.robot_type
    for other in ROBOTS.names() if joints and robot in ROBOTS.names() else ():
        if other != robot and all(other in name for name in joints[:-1]):
            yield f"robot_type is {robot}, the joints are those of {other}"
    known = ROBOTS.load(robot).arm_joints if robot in ROBOTS.names() else ()
    lacking = [joint for joint in known if joint not in joints]
    if lacking and len(lacking) <= len(known) / 2 and len(joints) >= len(known):  # of an arm called otherwise all are
        yield f"robot_type is {robot}, no joint is its {lacking[0]}"


def _videos(dataset: Dataset) -> Iterator[str]:
    for key in dataset.info.video_keys:
        feature = dataset.info.features[key]
        height, width = feature.shape[:2]
        info = feature.info or {}
        said: dict[str, Any] = {"height": height, "width": width}
        said |= {name: info[f"video.{name}"] for name in ("codec", "pix_fmt") if info.get(f"video.{name}")}
        said |= {"sound": info["has_audio"]} if isinstance(info.get("has_audio"), bool) else {}
        for path in dict.fromkeys(place.videos[key][0] for place in dataset.places):
            found, rate = _stream(path)
            for quantity, value in found.items():
                if quantity in said and said[quantity] != value:
                    yield f"{key}: {quantity} is {said[quantity]} in info.json, {value} in {path.name}"
            if not abs(rate - dataset.info.fps) <= _RATE_TOLERANCE * dataset.info.fps:
                yield f"{key}: fps is {dataset.info.fps} in info.json, {rate:.4g} in {path.name}"
        if feature.is_depth and feature.shape[2] != 1:
            yield f"{key} is a depth map of {feature.shape[2]} channels"
        for quantity, value in (("height", height), ("width", width), ("channels", feature.shape[2])):
            if info.get(f"video.{quantity}", value) != value:
                yield f"{key}: video.{quantity} is {info[f'video.{quantity}']}, the shape has {value}"
        if info.get("video.fps", dataset.info.fps) != dataset.info.fps:
            yield f"{key}: video.fps is {info['video.fps']}, the dataset has {dataset.info.fps}"


def _stream(path: Path) -> tuple[dict[str, Any], float]:
    """What an mp4 file says of its images, and how many a second it has."""
    import av

    check_video(path)
    try:
        with av.open(str(path), format="mp4") as container:
            context = container.streams.video[0].codec_context
            rate = container.streams.video[0].average_rate
            codec = {"libdav1d": "av1"}.get(context.name, context.name)
            found = {"height": context.height, "width": context.width, "pix_fmt": context.pix_fmt, "codec": codec}
            found["sound"] = bool(container.streams.audio)
    except (OSError, IndexError, av.FFmpegError) as error:
        raise ExportError(f"The video cannot be opened ({describe_error(error)}): {path}") from error
    return found, float(rate or 0)


def _splits(dataset: Dataset) -> Iterator[str]:
    """Every episode in one split, none beyond."""
    splits = read_json(dataset.path / INFO_PATH).get("splits")
    if splits is None:
        return
    used: list[int] = []
    try:
        for text in splits.values():
            first, last = (int(part) for part in text.split(":"))
            if not 0 <= first <= last <= dataset.info.total_episodes:
                raise ValueError(text)
            used += range(first, last)
    except (AttributeError, TypeError, ValueError):
        yield f"the splits {str(splits)[:80]} are no ranges of its {dataset.info.total_episodes} episodes"
        return
    if sorted(used) != list(range(dataset.info.total_episodes)):
        yield f"the splits have {len(used)} of {dataset.info.total_episodes} episodes"


@sidecar_check(
    measures="statements of info.json that the episodes' own descriptions contradict",
)
def dataset_description(dataset: Dataset) -> Measurement | None:
    """Robot, rate, names of components and sizes of images are those of the scenes that the sidecar keeps."""
    if not dataset.infos:
        return None
    wrong = [
        f"episode {each.number}: {words}"
        for each in dataset.described()
        for words in _described(dataset, each.info, int(each.kept["frame_stride"]))
    ]
    return Measurement(value=len(wrong), detail="; ".join(wrong[:3]) or f"{len(dataset.infos)} episodes")


def _described(dataset: Dataset, info: EpisodeInfo, stride: int) -> Iterator[str]:
    features = dataset.info.features
    if dataset.info.robot_type != info.robot.name:
        yield f"robot_type is {dataset.info.robot_type}, the robot was {info.robot.name}"
    if stride < 1 or info.fps != dataset.info.fps * stride:
        yield f"fps is {dataset.info.fps}, every {stride}. of {info.fps} frames a second was taken"
    state = dataset.state_kind(info) or "joint"
    expected = observation_names(info.robot, info.scene, privileged=ENVIRONMENT_STATE in features, state=state)
    for name, names in expected.items():
        if name in features and features[name].names != names:
            yield f"the components of {name} are not those of the robot in their order"
    if ACTION in features and dataset.action_kind(info) is None:
        yield "the components of the action are none that demorec writes"
    for camera in info.scene.cameras:
        feature = features.get(IMAGE_PREFIX + camera.name)
        if feature is not None and feature.shape != (camera.height, camera.width, 3):
            yield f"the camera {camera.name} has {camera.width}x{camera.height} pixels, its feature {feature.shape}"

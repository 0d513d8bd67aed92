"""One recording to one episode of a dataset: features, coded pictures, statistics of the pixels, sidecar row."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from demorec.errors import ConfigError, ExportError
from demorec.export.depth import DEPTH_SUFFIX, depth_info, depth_video
from demorec.export.layout import AUTOMATIC_FEATURES, IMAGE_PREFIX, Feature
from demorec.export.options import ExportOptions
from demorec.export.sidecar import EpisodeRecord
from demorec.export.stats import PixelHistogram, colour_levels
from demorec.export.transcode import coded_videos, dataset_settings, video_info
from demorec.export.writer import EpisodeData
from demorec.features import (
    ACTION,
    ENVIRONMENT_STATE,
    ObservationRows,
    action_names,
    action_vectors,
    observation_names,
    observation_vectors,
)
from demorec.recording import Recording
from demorec.registry import nearest_match

REWARD, DONE, SUCCESS = "next.reward", "next.done", "next.success"

_SCALARS = {
    REWARD: Feature(dtype="float32", shape=(1,)),
    DONE: Feature(dtype="bool", shape=(1,)),
    SUCCESS: Feature(dtype="bool", shape=(1,)),
}


@dataclass(frozen=True, kw_only=True, eq=False)
class PreparedEpisode:
    """What came of one recording: for the dataset, and for what stands beside it."""

    data: EpisodeData
    record: EpisodeRecord


def frame_stride(recording_fps: int, fps: int | None) -> int:
    """How many frames of the recording make one of the dataset.

    Raises:
        ConfigError: The wanted fps does not divide that of the recording.
    """
    if fps is None:
        return 1
    if recording_fps % fps:
        divisors = [str(n) for n in range(1, recording_fps + 1) if recording_fps % n == 0]
        raise ConfigError(
            f"fps is {fps}, which does not divide the recordings' {recording_fps}: allowed are {', '.join(divisors)}."
        )
    return recording_fps // fps


def dataset_features(recording: Recording, options: ExportOptions) -> dict[str, Feature]:
    """The features that recordings like this one give with these options, in the order of the dataset.

    Raises:
        ConfigError: `options.features` names one that they do not give.
        ConfigError: The wanted fps does not divide that of the recording.
    """
    info = recording.info
    stride = frame_stride(info.fps, options.fps)
    features = {
        name: Feature(dtype="float32", shape=(len(names),), names=names)
        for name, names in observation_names(info.robot, info.scene, privileged=options.privileged).items()
    }
    for camera in recording.cameras:
        settings = dataset_settings(recording.video_settings(camera), options.transcode, stride=stride)
        height, width = settings.height, settings.width
        features[IMAGE_PREFIX + camera] = _camera_feature((height, width, 3), video_info(settings))
        if options.depth:
            described = depth_info(width=width, height=height, fps=settings.fps)
            features[IMAGE_PREFIX + camera + DEPTH_SUFFIX] = _camera_feature((height, width, 1), described)
    names = action_names(info.robot, options.action)
    features[ACTION] = Feature(dtype="float32", shape=(len(names),), names=names)
    return _chosen({**features, **_SCALARS, **AUTOMATIC_FEATURES}, options)


def _chosen(offered: dict[str, Feature], options: ExportOptions) -> dict[str, Feature]:
    """Those of the offered features that the dataset shall have."""
    for name in options.features:
        if name == ENVIRONMENT_STATE and name not in offered:
            raise ConfigError(f"The feature {name} is named in --features, but only --privileged adds it.")
        if name not in offered:
            raise ConfigError(
                f"Unknown feature {name!r}.{nearest_match(name, offered)} The recordings and these options give: "
                f"{', '.join(offered)}."
            )
    return {name: feature for name, feature in offered.items() if name in AUTOMATIC_FEATURES or options.takes(name)}


def _camera_feature(shape: tuple[int, int, int], info: dict[str, object]) -> Feature:
    return Feature(dtype="video", shape=shape, names=("height", "width", "channels"), info=info)


def prepare_episode(recording: Recording, options: ExportOptions, *, code_depth: bool = True) -> PreparedEpisode:
    """Read a recording into memory, as the dataset wants it; depth videos, which must be coded, only with `code_depth`.

    With frames left out, an observation is that of the first frame of its group and an action the last one of it:
    where the robot shall be when the next observation is taken.

    Raises:
        ExportError: It has no frames, or a kind of picture is missing that was asked for.
        RecordingError: It is damaged.
    """
    info = recording.info
    if recording.num_frames == 0:
        raise ExportError(f"The recording has no frames: {recording.path}")
    stride = frame_stride(info.fps, options.fps)
    columns = recording.columns()
    rows = np.arange(0, recording.num_frames, stride)
    action_rows = np.minimum(rows + stride - 1, recording.num_frames - 1)
    wanted = dataset_features(recording, options)
    features: dict[str, NDArray[np.generic]] = dict(
        observation_vectors(
            ObservationRows.of_columns(columns, rows), info.robot, info.scene, privileged=options.privileged
        )
    )
    features[ACTION] = action_vectors(columns, info.scene, options.action, action_rows)
    success = recording.outcome is not None and recording.outcome.success
    is_last = rows == rows[-1]
    features[REWARD] = (is_last & success).astype(np.float32)
    features[DONE] = is_last
    features[SUCCESS] = is_last & success
    videos, pixels = {}, {}
    cameras = [camera for camera in recording.cameras if IMAGE_PREFIX + camera in wanted]
    for camera, video in coded_videos(recording, cameras, options.transcode, rows).items():
        key = IMAGE_PREFIX + camera
        videos[key] = video
        statistics = recording.pixel_statistics(camera)
        pixels[key] = PixelHistogram(
            counts=statistics.counts, level_values=colour_levels(), num_pictures=statistics.num_images
        )
    for camera in recording.cameras if code_depth else ():
        key = IMAGE_PREFIX + camera + DEPTH_SUFFIX
        if key in wanted:
            pictures = (picture for index, picture in enumerate(recording.depth(camera)) if index % stride == 0)
            videos[key], pixels[key] = depth_video(pictures, fps=info.fps // stride)
    data = EpisodeData(
        task=info.instruction,
        columns={name: values for name, values in features.items() if name in wanted},
        videos=videos,
        video_info={key: wanted[key].info or {} for key in videos},
        pixels=pixels,
    )
    return PreparedEpisode(data=data, record=EpisodeRecord.of(recording, columns, rows))

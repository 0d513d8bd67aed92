"""One recording to one episode of a dataset: features, coded pictures, statistics of the pixels, sidecar row."""

from __future__ import annotations

from dataclasses import dataclass

from demorec.export.columns import (
    DONE,
    INTERVENTION,
    REWARD,
    SUCCESS,
    check_feature_names,
    feature_columns,
    frame_stride,
)
from demorec.lerobot.depth import depth_info, depth_video
from demorec.lerobot.layout import AUTOMATIC_FEATURES, Feature
from demorec.lerobot.options import ExportOptions
from demorec.lerobot.sidecar import EpisodeRecord
from demorec.lerobot.stats import PixelHistogram, colour_levels
from demorec.lerobot.transcode import coded_videos, dataset_settings, video_info
from demorec.lerobot.writer import EpisodeData
from demorec.recording import Recording
from demorec.scene.features import ACTION, DEPTH_SUFFIX, IMAGE_PREFIX, action_names, observation_names

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
    if options.intervention:
        features[INTERVENTION] = Feature(dtype="bool", shape=(1,))
    return _chosen({**features, **_SCALARS, **AUTOMATIC_FEATURES}, options)


def _chosen(offered: dict[str, Feature], options: ExportOptions) -> dict[str, Feature]:
    """Those of the offered features that the dataset shall have."""
    check_feature_names(options, offered)
    return {name: feature for name, feature in offered.items() if name in AUTOMATIC_FEATURES or options.takes(name)}


def _camera_feature(shape: tuple[int, int, int], info: dict[str, object]) -> Feature:
    return Feature(dtype="video", shape=shape, names=("height", "width", "channels"), info=info)


def prepare_episode(recording: Recording, options: ExportOptions, *, code_depth: bool = True) -> PreparedEpisode:
    """Read a recording into memory, as the dataset wants it; depth videos, which must be coded, only with `code_depth`.

    Raises:
        ExportError: It has no frames, or a kind of picture is missing that was asked for.
        RecordingError: It is damaged.
    """
    stride = frame_stride(recording.info.fps, options.fps)
    wanted = dataset_features(recording, options)
    columns = feature_columns(recording, options)
    videos, pixels = {}, {}
    cameras = [camera for camera in recording.cameras if IMAGE_PREFIX + camera in wanted]
    for camera, video in coded_videos(recording, cameras, options.transcode, columns.rows).items():
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
            videos[key], pixels[key] = depth_video(pictures, fps=recording.info.fps // stride)
    data = EpisodeData(
        task=recording.info.instruction,
        columns={name: values for name, values in columns.features.items() if name in wanted},
        videos=videos,
        video_info={key: wanted[key].info or {} for key in videos},
        pixels=pixels,
    )
    return PreparedEpisode(data=data, record=EpisodeRecord.of(recording, columns.recorded, columns.rows))

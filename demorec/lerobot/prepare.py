"""One recording to one episode of a dataset: features, coded pictures, statistics of the pixels, sidecar row."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from demorec.errors import ConfigError
from demorec.export.columns import (
    DONE,
    INTERVENTION,
    REWARD,
    SUCCESS,
    FeatureColumns,
    check_feature_names,
    feature_columns,
    frame_stride,
)
from demorec.language.masks import seen_objects
from demorec.language.narration import narrate
from demorec.language.progress import dense_runs
from demorec.language.tries import story_of
from demorec.lerobot.boxes import EpisodeBoxes
from demorec.lerobot.collected import collected_features, prepare_collected, reasons_to_transcode
from demorec.lerobot.depth import depth_info, depth_video
from demorec.lerobot.facts import episode_facts
from demorec.lerobot.language import COLUMNS, EpisodeLanguage, episode_language
from demorec.lerobot.layout import AUTOMATIC_FEATURES, LANGUAGE_FEATURE, Feature
from demorec.lerobot.options import ExportOptions
from demorec.lerobot.progress import EpisodeProgress
from demorec.lerobot.sidecar import EpisodeRecord
from demorec.lerobot.stats import PixelHistogram, colour_levels
from demorec.lerobot.transcode import coded_videos, dataset_settings, reason_to_transcode, video_info
from demorec.lerobot.writer import EpisodeData
from demorec.recording import AnyRecording, CollectedRecording, Recording
from demorec.scene.features import ACTION, DEPTH_SUFFIX, IMAGE_PREFIX, action_names, observation_names

_SCALARS = {
    REWARD: Feature(dtype="float32", shape=(1,)),
    DONE: Feature(dtype="bool", shape=(1,)),
    SUCCESS: Feature(dtype="bool", shape=(1,)),
}


@dataclass(frozen=True, kw_only=True, eq=False)
class PreparedEpisode:
    """What came of one recording: for the dataset, and for what stands beside it.

    Attributes:
        data: For the dataset.
        record: For the sidecar.
        boxes: Camera feature -> what it sees, if that was asked for.
    """

    data: EpisodeData
    record: EpisodeRecord
    boxes: Mapping[str, EpisodeBoxes] = field(default_factory=dict)


def dataset_features(recording: AnyRecording, options: ExportOptions) -> dict[str, Feature]:
    """The features that recordings like this one give with these options, in the order of the dataset.

    Raises:
        ConfigError: `options.features` names one that they do not give.
        ConfigError: The wanted fps does not divide that of the recording.
    """
    if isinstance(recording, CollectedRecording):
        return collected_features(recording, options)
    info = recording.info
    stride = frame_stride(info.fps, options.fps)
    vectors = observation_names(info.robot, info.scene, privileged=options.privileged, state=options.state)
    features = {name: Feature(dtype="float32", shape=(len(names),), names=names) for name, names in vectors.items()}
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
    told = {} if options.language is None else dict.fromkeys(COLUMNS, LANGUAGE_FEATURE)
    return {**_chosen({**features, **_SCALARS, **AUTOMATIC_FEATURES}, options), **told}


def _chosen(offered: dict[str, Feature], options: ExportOptions) -> dict[str, Feature]:
    """Those of the offered features that the dataset shall have."""
    check_feature_names(options, offered)
    return {name: feature for name, feature in offered.items() if name in AUTOMATIC_FEATURES or options.takes(name)}


def _camera_feature(shape: tuple[int, int, int], info: dict[str, object]) -> Feature:
    return Feature(dtype="video", shape=shape, names=("height", "width", "channels"), info=info)


def transcoded_cameras(recording: AnyRecording, options: ExportOptions) -> tuple[str, ...]:
    """Cameras whose pictures have to be coded anew, with the reason."""
    if isinstance(recording, CollectedRecording):
        reasons = reasons_to_transcode(recording, options)
    else:
        stride = frame_stride(recording.info.fps, options.fps)
        features = dataset_features(recording, options)
        cameras = [name for name in recording.cameras if IMAGE_PREFIX + name in features]
        reasons = {name: reason_to_transcode(recording.video_settings(name), stride) for name in cameras}
    return tuple(f"{camera}, {reason}" for camera, reason in reasons.items() if reason)


def prepare_episode(
    recording: AnyRecording, options: ExportOptions, *, code_depth: bool = True, about: Collection[int] | None = None
) -> PreparedEpisode:
    """Read a recording into memory, as the dataset wants it.

    Args:
        recording: Of a simulated or of a collected episode.
        options: How.
        code_depth: Whether depth videos, which must be coded, are made.
        about: The rows whose pictures are spoken of, if language is asked for; None for all.

    Raises:
        ConfigError: A kind of picture is missing that was asked for.
        ExportError: It has no frames.
        RecordingError: It is damaged.
    """
    if isinstance(recording, CollectedRecording):
        episode, row = prepare_collected(recording, options, code_depth=code_depth)
        return PreparedEpisode(data=episode, record=EpisodeRecord.of_collected(row, recording))
    stride = frame_stride(recording.info.fps, options.fps)
    wanted = dataset_features(recording, options)
    columns = feature_columns(recording, options, state=options.state)
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
        language=_language(recording, columns, options, about),
        facts=_facts(recording, columns, options),
    )
    return PreparedEpisode(
        data=data,
        record=EpisodeRecord.of(recording, columns.recorded, columns.rows, options.state),
        boxes=_boxes(recording, columns, cameras) if options.boxes else {},
    )


def _language(
    recording: Recording, columns: FeatureColumns, options: ExportOptions, about: Collection[int] | None
) -> EpisodeLanguage:
    """What the dataset shall say about the recording; nothing unless it was asked for."""
    if options.language is None:
        return EpisodeLanguage()
    cameras = [camera for camera in recording.cameras if options.takes(IMAGE_PREFIX + camera)]
    if "vqa" in (options.language or ()) and not any(map(recording.has_segmentation, cameras)):
        raise ConfigError(
            "Questions about pictures (vqa) need recordings with segmentation (generate --segmentation), leave them "
            f"out: {recording.path}"
        )
    told = narrate(recording, columns.recorded, columns.rows, options.spoken, cameras, about=about)
    return episode_language(told, fps=recording.info.fps // frame_stride(recording.info.fps, options.fps))


def _facts(recording: Recording, columns: FeatureColumns, options: ExportOptions) -> dict[str, Any]:
    """What is known of the episode, its stages among it if they were asked for."""
    facts = episode_facts(recording, columns.recorded)
    if options.progress:
        runs = dense_runs(story_of(recording, columns.recorded), columns.rows)
        facts |= EpisodeProgress(num_goals=len(recording.info.scene.goals), dense=tuple(runs)).row()
    return facts


def _boxes(recording: Recording, columns: FeatureColumns, cameras: Sequence[str]) -> dict[str, EpisodeBoxes]:
    """Camera feature -> what it sees, of the cameras that have segmentation.

    Raises:
        ConfigError: None has.
    """
    scene = recording.info.scene
    found = [camera for camera in scene.cameras if camera.name in cameras and recording.has_segmentation(camera.name)]
    if not found:
        raise ConfigError(
            f"Boxes need recordings with segmentation (generate --segmentation), leave them out: {recording.path}"
        )
    return {
        IMAGE_PREFIX + camera.name: EpisodeBoxes(
            width=camera.width,
            height=camera.height,
            num_frames=len(columns.rows),
            objects=tuple(seen_objects(recording, columns.recorded, columns.rows, camera)),
        )
        for camera in found
    }

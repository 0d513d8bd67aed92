"""One recording to one episode of a dataset: features, coded pictures, statistics of the pixels, sidecar row."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

from demorec.annotate.grounding import seen_objects
from demorec.annotate.narration import Statement, narrate
from demorec.annotate.progress import dense_runs
from demorec.annotate.tries import story_of
from demorec.core.errors import ConfigError
from demorec.datasets.episode import SCALARS, ExportCamera, ExportEpisode
from demorec.datasets.lerobot.boxes import EpisodeBoxes
from demorec.datasets.lerobot.depth import depth_info, depth_video
from demorec.datasets.lerobot.facts import episode_facts
from demorec.datasets.lerobot.language import COLUMNS, EpisodeLanguage, episode_language
from demorec.datasets.lerobot.layout import AUTOMATIC_FEATURES, LANGUAGE_FEATURE, DatasetFeature
from demorec.datasets.lerobot.options import ExportOptions
from demorec.datasets.lerobot.progress import EpisodeProgress
from demorec.datasets.lerobot.sidecar import EpisodeRecord
from demorec.datasets.lerobot.stats import PixelHistogram, colour_levels
from demorec.datasets.lerobot.transcode import coded_videos, dataset_settings, reason_to_transcode, video_info
from demorec.datasets.lerobot.writer import EpisodeData
from demorec.episode.features import ACTION, IMAGE_PREFIX


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


def dataset_features(episode: ExportEpisode, options: ExportOptions) -> dict[str, DatasetFeature]:
    """The features that episodes like this one give with these options, in the order of the dataset."""
    vectors = {
        name: DatasetFeature(dtype="float32", shape=(len(names),), names=names)
        for name, names in episode.names.items()
        if options.takes(name)
    }
    images = {camera.feature: _camera_feature(episode, camera, options) for camera in episode.cameras}
    action = {ACTION: vectors.pop(ACTION)} if ACTION in vectors else {}
    scalars = {name: DatasetFeature(dtype=SCALARS[name], shape=(1,)) for name in episode.scalars if options.takes(name)}
    told = {} if options.language is None else dict.fromkeys(COLUMNS, LANGUAGE_FEATURE)
    return {**vectors, **images, **action, **scalars, **AUTOMATIC_FEATURES, **told}


def _camera_feature(episode: ExportEpisode, camera: ExportCamera, options: ExportOptions) -> DatasetFeature:
    settings = episode.recording.video_settings(camera.name)
    size = {"height": settings.height, "width": settings.width}
    if camera.is_depth:
        info = depth_info(**size, fps=episode.fps)
    else:
        reason = reason_to_transcode(episode, camera)
        info = video_info(dataset_settings(episode, camera, options.transcode, reason))
    shape = (*size.values(), 1 if camera.is_depth else 3)
    return DatasetFeature(dtype="video", shape=shape, names=("height", "width", "channels"), info=info)


def reasons_to_transcode(episode: ExportEpisode) -> dict[ExportCamera, str]:
    """Colour camera -> why its images have to be coded anew, "" where they pass through."""
    return {camera: reason_to_transcode(episode, camera) for camera in episode.cameras if not camera.is_depth}


def prepare_episode(
    episode: ExportEpisode, options: ExportOptions, *, code_depth: bool = True, about: Collection[int] | None = None
) -> PreparedEpisode:
    """Read an episode into memory, as the dataset wants it.

    Args:
        episode: Of an open recording.
        options: How.
        code_depth: Whether depth videos, which must be coded, are made.
        about: The rows whose images are spoken of, if language is asked for; None for all.

    Raises:
        ConfigError: A kind of image is missing that was asked for.
        ExportError: It has no frames, or frames without images.
        RecordingError: It is damaged.
    """
    wanted = dataset_features(episode, options)
    videos = coded_videos(episode, reasons_to_transcode(episode), options.transcode)
    pixels = {}
    for camera in episode.cameras:
        if not camera.is_depth:
            statistics = episode.recording.pixel_statistics(camera.name)
            pixels[camera.feature] = PixelHistogram(
                counts=statistics.counts, level_values=colour_levels(), num_pictures=statistics.num_images
            )
        elif code_depth:
            videos[camera.feature], pixels[camera.feature] = depth_video(episode.images(camera), fps=episode.fps)
        else:
            episode.numbers(camera)  # says what is missing
    data = EpisodeData(
        task=episode.recording.info.instruction,
        columns=episode.singles,
        videos=videos,
        video_info={key: wanted[key].info or {} for key in videos},
        pixels=pixels,
        language=_language(episode, options, about),
        facts=_facts(episode, options),
    )
    return PreparedEpisode(
        data=data,
        record=EpisodeRecord.of(episode),
        boxes=_boxes(episode) if options.boxes else {},
    )


def _language(episode: ExportEpisode, options: ExportOptions, about: Collection[int] | None) -> EpisodeLanguage:
    """What the dataset shall say about the episode; nothing unless it was asked for."""
    if options.language is None:
        return EpisodeLanguage()
    if (simulated := episode.simulated) is None:
        stated = [Statement(row=frame, kind="subtask", role="assistant", text=text) for frame, text in episode.subtasks]
        return episode_language(stated, fps=episode.fps)
    recording = simulated.recording
    cameras = [camera for camera in recording.cameras if options.takes(IMAGE_PREFIX + camera)]
    if "vqa" in (options.language or ()) and not any(map(recording.has_segmentation, cameras)):
        raise ConfigError(
            "Questions about images (vqa) need recordings with segmentation (generate --segmentation), leave them "
            f"out: {recording.path}"
        )
    told = narrate(recording, simulated.columns, episode.rows, options.spoken, cameras, about=about)
    return episode_language(told, fps=episode.fps)


def _facts(episode: ExportEpisode, options: ExportOptions) -> dict[str, Any]:
    """What is known of a simulated episode, its stages among it if they were asked for."""
    if (simulated := episode.simulated) is None:
        return {}
    facts = episode_facts(simulated.recording, simulated.columns)
    if options.progress:
        runs = dense_runs(story_of(simulated.recording, simulated.columns), episode.rows)
        num_goals = len(simulated.recording.info.scene.goals)
        facts |= EpisodeProgress(num_goals=num_goals, dense=tuple(runs)).row()
    return facts


def _boxes(episode: ExportEpisode) -> dict[str, EpisodeBoxes]:
    """Camera feature -> what it sees, of the cameras that have segmentation.

    Raises:
        ConfigError: None has.
    """
    boxes = {}
    if (simulated := episode.simulated) is not None:
        taken = {camera.name for camera in episode.cameras}
        for camera in simulated.recording.info.scene.cameras:
            if camera.name in taken and simulated.recording.has_segmentation(camera.name):
                seen = seen_objects(simulated.recording, simulated.columns, episode.rows, camera)
                boxes[IMAGE_PREFIX + camera.name] = EpisodeBoxes(
                    width=camera.width, height=camera.height, num_frames=len(episode.rows), objects=tuple(seen)
                )
    if not boxes:
        raise ConfigError(
            "Boxes need recordings with segmentation (generate --segmentation), leave them out: "
            f"{episode.recording.path}"
        )
    return boxes

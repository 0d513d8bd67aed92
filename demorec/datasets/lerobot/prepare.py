"""One recording to one episode of a dataset: features, encoded images, statistics of the pixels, sidecar row."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np

from demorec.annotate import Statement
from demorec.annotate.attempts import episode_timeline
from demorec.annotate.boxes import seen_objects
from demorec.annotate.progress import dense_runs
from demorec.annotate.statements import episode_statements
from demorec.core.config import VideoConfig
from demorec.core.errors import ConfigError, ExportError
from demorec.datasets.episode import SCALARS, ExportCamera, ExportEpisode
from demorec.datasets.lerobot.boxes import SeenByCamera, box_entry
from demorec.datasets.lerobot.depth import depth_info, depth_video
from demorec.datasets.lerobot.facts import EpisodeProgress, episode_facts
from demorec.datasets.lerobot.language import COLUMNS, EpisodeLanguage, episode_language
from demorec.datasets.lerobot.layout import AUTOMATIC_FEATURES, LANGUAGE_FEATURE, DatasetFeature
from demorec.datasets.lerobot.mp4 import EncodedVideo
from demorec.datasets.lerobot.options import ExportOptions
from demorec.datasets.lerobot.stats import PixelHistogram, colour_levels
from demorec.datasets.lerobot.writer import EpisodeData
from demorec.episode.features import ACTION, IMAGE_PREFIX
from demorec.mcap import Recording, VideoSettings
from demorec.mcap.video import make_encoder


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
    language = {} if options.language is None else dict.fromkeys(COLUMNS, LANGUAGE_FEATURE)
    return {**vectors, **images, **action, **scalars, **AUTOMATIC_FEATURES, **language}


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
    """Colour camera -> why its images have to be encoded anew, "" where they pass through."""
    return {camera: reason_to_transcode(episode, camera) for camera in episode.cameras if not camera.is_depth}


def prepare_episode(episode: ExportEpisode, options: ExportOptions, *, encode_depth: bool = True) -> EpisodeData:
    """Read an episode into memory, as the dataset wants it.

    Args:
        encode_depth: Whether depth videos, which must be encoded, are made.

    Raises:
        ConfigError: A kind of image is missing that was asked for.
        ExportError: It has no frames, or frames without images.
        RecordingError: It is damaged.
    """
    wanted = dataset_features(episode, options)
    videos = encoded_videos(episode, reasons_to_transcode(episode), options.transcode)
    pixels = {}
    for camera in episode.cameras:
        if not camera.is_depth:
            statistics = episode.recording.pixel_statistics(camera.name)
            pixels[camera.feature] = PixelHistogram(
                counts=statistics.counts, level_values=colour_levels(), num_images=statistics.num_images
            )
        elif encode_depth:
            videos[camera.feature], pixels[camera.feature] = depth_video(episode.images(camera), fps=episode.fps)
        else:
            episode.numbers(camera)  # says what is missing
    return EpisodeData(
        task=episode.recording.info.instruction,
        columns=episode.singles,
        videos=videos,
        video_info={key: wanted[key].info or {} for key in videos},
        pixels=pixels,
        language=_language(episode, options),
        facts=_facts(episode, options),
    )


def _language(episode: ExportEpisode, options: ExportOptions) -> EpisodeLanguage:
    """What the dataset shall say about the episode; nothing unless it was asked for."""
    if options.language is None:
        return EpisodeLanguage()
    recording = episode.recording
    if episode.info.simulation is None:
        stated = [
            Statement(row=frame, kind="subtask", role="assistant", text=text) for frame, text in recording.subtasks
        ]
        return episode_language(stated, fps=episode.fps)
    statements = episode_statements(recording, episode.trajectory, episode.rows, options.spoken)
    return episode_language(statements, fps=episode.fps)


def _facts(episode: ExportEpisode, options: ExportOptions) -> dict[str, Any]:
    """What is known of a simulated episode, its stages among it if they were asked for."""
    if episode.info.simulation is None:
        return {}
    facts = episode_facts(episode.recording, episode.trajectory)
    if options.progress:
        runs = dense_runs(episode_timeline(episode.recording, episode.trajectory), episode.rows)
        num_goals = len(episode.info.simulated.scene.goals)
        facts |= EpisodeProgress(num_goals=num_goals, runs=tuple(runs)).row()
    return facts


def episode_boxes(episode: ExportEpisode) -> dict[str, SeenByCamera]:
    """Camera feature -> what it sees, of the cameras that have segmentation.

    Raises:
        ConfigError: None has.
    """
    boxes = {}
    if episode.info.simulation is not None:
        taken = {camera.name for camera in episode.cameras}
        for camera in episode.info.simulated.scene.cameras:
            if camera.name in taken and episode.recording.has_segmentation(camera.name):
                seen = seen_objects(episode.recording, episode.trajectory, episode.rows, camera)
                entries = tuple(box_entry(item) for item in seen)
                boxes[IMAGE_PREFIX + camera.name] = camera.width, camera.height, entries
    if not boxes:
        raise ConfigError(
            "Boxes need recordings with segmentation (generate --segmentation), leave them out: "
            f"{episode.recording.path}"
        )
    return boxes


def reason_to_transcode(episode: ExportEpisode, camera: ExportCamera) -> str:
    """Why the images of a camera cannot pass through as they are, in words; "" if they can.

    With frames left out, the others stay decodable only if they are all keyframes.
    """
    settings = episode.recording.video_settings(camera.name)
    if settings.codec == "jpeg":
        return "jpeg images are no video"
    numbers = episode.numbers(camera)
    stride = _stride(episode)
    if (np.diff(numbers) != stride).any():
        return "frames show images again, or leave some out"
    if stride > 1 and (settings.gop == 0 or stride % settings.gop):
        return f"every {_ordinal(stride)} frame is taken and every {_ordinal(settings.gop)} is a keyframe"
    if stride == 1 and len(numbers) and _lead(episode.recording, camera.name, int(numbers[0])) > len(numbers):
        return "the keyframe that the first frame needs is further away than the episode is long"
    return ""


def _stride(episode: ExportEpisode) -> int:
    return episode.recording.info.fps // episode.fps


def _ordinal(number: int) -> str:
    return {1: "1st", 2: "2nd", 3: "3rd"}.get(number, f"{number}th")


def _lead(recording: Recording, camera: str, number: int) -> int:
    """How many images from the last keyframe on come before one: recordings of video begin with a keyframe."""
    if number == 0:
        return 0
    packets = islice(recording.packets(camera), number + 1)
    return number - max((packet.frame_index for packet in packets if packet.is_keyframe), default=0)


def dataset_settings(episode: ExportEpisode, camera: ExportCamera, video: VideoConfig, reason: str) -> VideoSettings:
    """How a camera's images are encoded in the dataset: as recorded, or, for a `reason`, as they will be transcoded."""
    settings = episode.recording.video_settings(camera.name)
    if reason:
        return make_encoder(video=video, width=settings.width, height=settings.height, fps=episode.fps).settings
    return replace(settings, fps=episode.fps, gop=settings.gop if _stride(episode) == 1 else 1)


def encoded_videos(
    episode: ExportEpisode, reasons: Mapping[ExportCamera, str], video: VideoConfig
) -> dict[str, EncodedVideo]:
    """Camera feature -> its images, one a frame: the recorded packets wherever there is no reason to transcode."""
    recording = episode.recording
    recorded = recording.coded_images([camera.name for camera, reason in reasons.items() if not reason])
    videos = {}
    for camera, reason in reasons.items():
        settings = dataset_settings(episode, camera, video, reason)
        codec, size = mp4_codec(settings), (settings.width, settings.height)
        if reason:
            encoder = make_encoder(video=video, width=size[0], height=size[1], fps=episode.fps)
            units = [unit for image in episode.images(camera) for unit in encoder.encode(image)]
            units += encoder.finish()
            lengths = [len(unit) for unit in units]
            videos[camera.feature] = EncodedVideo.of_access_units(codec, *size, b"".join(units), lengths)
            continue
        numbers = episode.numbers(camera)
        is_whole = _stride(episode) == 1
        lead = _lead(recording, camera.name, int(numbers[0])) if is_whole else 0
        block = recorded.pop(camera.name)
        if lead or len(block) != len(numbers):
            taken = np.arange(numbers[0] - lead, numbers[-1] + 1) if is_whole else numbers
            block = block.select(taken.astype(np.intp))
        coded = EncodedVideo.of_access_units(codec, *size, block.joined(), block.lengths, lead)
        if not is_whole and not coded.is_keyframe.all():
            gop = recording.video_settings(camera.name).gop
            raise ExportError(
                f"The recording says that every {_ordinal(gop)} image of camera {camera.name} is a keyframe, "
                f"but it is not so: {recording.path}"
            )
        videos[camera.feature] = coded
    return videos


def mp4_codec(settings: VideoSettings) -> str:
    """The name that mp4 files and LeRobot have for the codec."""
    return "hevc" if settings.codec == "h265" else settings.codec


def video_info(settings: VideoSettings) -> dict[str, Any]:
    """The `info` of a camera feature: what LeRobot reads from a file, and how it was encoded, null where unknown.

    LeRobot codes anew with these settings when it takes episodes out of a dataset, and takes its own for those that are
    null; a GOP of 0 it refuses.
    """
    preset = int(settings.preset) if settings.preset.isdigit() else settings.preset or None
    return {
        "video.height": settings.height,
        "video.width": settings.width,
        "video.codec": mp4_codec(settings),
        "video.pix_fmt": settings.pix_fmt,
        "video.fps": settings.fps,
        "video.channels": 3,
        "has_audio": False,
        "video.g": settings.gop or None,
        "video.crf": settings.crf,
        "video.preset": preset,
        "video.fast_decode": 0,
        "video.video_backend": "pyav",
        "video.extra_options": dict(settings.options),
        "is_depth_map": False,
    }

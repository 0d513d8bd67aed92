"""The recording of a collected episode to an episode of a dataset: its packets as they are, where that is possible."""

from __future__ import annotations

from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.config import VideoConfig
from demorec.errors import ExportError
from demorec.export.collected import (
    check_options,
    collected_data,
    shown,
    shown_pictures,
    wanted_cameras,
    wanted_depth,
)
from demorec.export.columns import DONE
from demorec.language.narration import Statement
from demorec.lerobot.depth import depth_info, depth_video
from demorec.lerobot.language import COLUMNS, EpisodeLanguage, episode_language
from demorec.lerobot.layout import AUTOMATIC_FEATURES, LANGUAGE_FEATURE, Feature
from demorec.lerobot.mp4 import CodedVideo
from demorec.lerobot.options import ExportOptions
from demorec.lerobot.stats import PixelHistogram, colour_levels
from demorec.lerobot.transcode import video_info
from demorec.lerobot.writer import EpisodeData
from demorec.plain import to_json
from demorec.recording import CollectedRecording, VideoSettings
from demorec.recording.video import make_encoder
from demorec.scene.features import IMAGE_PREFIX

_MP4_CODECS = {"h265": "hevc"}
"""Names that mp4 files and LeRobot have for codecs."""


def collected_features(recording: CollectedRecording, options: ExportOptions) -> dict[str, Feature]:
    """The features that recordings like this one give with these options; ConfigError as `check_options`."""
    check_options(recording, options)
    features = {
        feature.name: Feature(dtype="float32", shape=(len(feature.names),), names=feature.names)
        for feature in recording.info.features
        if options.takes(feature.name)
    }
    reasons = reasons_to_transcode(recording, options)
    for camera in wanted_cameras(recording, options):
        settings = _dataset_settings(recording, camera, options.transcode, reasons[camera])
        info = video_info(settings)
        info["video.codec"] = _MP4_CODECS.get(settings.codec, settings.codec)
        shape = (settings.height, settings.width, 3)
        features[IMAGE_PREFIX + camera] = Feature(
            dtype="video", shape=shape, names=("height", "width", "channels"), info=info
        )
    for camera in wanted_depth(recording, options):
        settings = recording.video_settings(camera)
        described = depth_info(width=settings.width, height=settings.height, fps=settings.fps)
        shape = (settings.height, settings.width, 1)
        features[IMAGE_PREFIX + camera] = Feature(
            dtype="video", shape=shape, names=("height", "width", "channels"), info=described
        )
    told = {} if options.language is None else dict.fromkeys(COLUMNS, LANGUAGE_FEATURE)
    return {**features, DONE: Feature(dtype="bool", shape=(1,)), **AUTOMATIC_FEATURES, **told}


def reasons_to_transcode(recording: CollectedRecording, options: ExportOptions) -> dict[str, str]:
    """Camera -> why its pictures cannot be taken over, in words; "" if they can."""
    columns = recording.columns()
    reasons = {}
    for camera in wanted_cameras(recording, options):
        numbers = shown_pictures(recording, columns, camera, options)
        if recording.video_settings(camera).codec == "jpeg":
            reasons[camera] = "jpeg pictures are no video"
        elif len(numbers) and (np.diff(numbers) != 1).any():
            reasons[camera] = "frames show pictures again, or leave some out"
        elif len(numbers) and _lead(recording, camera, int(numbers[0])) > len(numbers):
            reasons[camera] = "the keyframe that the first frame needs is further away than the episode is long"
        else:
            reasons[camera] = ""
    return reasons


def _lead(recording: CollectedRecording, camera: str, number: int) -> int:
    """How many pictures from the last keyframe on come before one: recordings of video begin with a keyframe."""
    packets = islice(recording.packets(camera), number + 1)
    return number - max((packet.frame_index for packet in packets if packet.is_keyframe), default=0)


def _dataset_settings(recording: CollectedRecording, camera: str, video: VideoConfig, reason: str) -> VideoSettings:
    settings = recording.video_settings(camera)
    if not reason:
        return settings
    return make_encoder(video=video, width=settings.width, height=settings.height, fps=recording.info.fps).settings


def prepare_collected(
    recording: CollectedRecording, options: ExportOptions, *, code_depth: bool
) -> tuple[EpisodeData, dict[str, Any]]:
    """Read a recording into memory, as the dataset wants it, and as its row in the sidecar says it.

    Depth videos, which must be coded, are made only with `code_depth`.

    Raises:
        ExportError: It has no frames, a number that float32 does not hold, or frames without pictures.
        RecordingError: It is damaged.
    """
    wanted = collected_features(recording, options)
    data = collected_data(recording, options)
    reasons = reasons_to_transcode(recording, options)
    videos, pixels = {}, {}
    for camera, numbers in data.pictures.items():
        key = IMAGE_PREFIX + camera
        if camera in recording.depth_cameras:
            if code_depth:
                pictures = shown(recording, camera, numbers)
                videos[key], pixels[key] = depth_video(pictures, fps=recording.info.fps)
            continue
        videos[key] = (
            _transcoded(recording, camera, options.transcode, numbers)
            if reasons[camera]
            else _kept(recording, camera, numbers)
        )
        statistics = recording.pixel_statistics(camera)
        pixels[key] = PixelHistogram(
            counts=statistics.counts, level_values=colour_levels(), num_pictures=statistics.num_images
        )
    episode = EpisodeData(
        task=recording.info.instruction,
        columns={name: _single(name, values, recording) for name, values in data.features.items()},
        videos=videos,
        video_info={key: wanted[key].info or {} for key in videos},
        pixels=pixels,
        language=_language(recording, options),
    )
    return episode, _sidecar_row(recording)


def _single(name: str, values: NDArray[np.generic], recording: CollectedRecording) -> NDArray[np.generic]:
    """(T, D) float32 of a feature's numbers; booleans stay."""
    if values.dtype == bool:
        return values
    with np.errstate(over="ignore"):
        found = values.astype(np.float32)
    if len(wrong := np.flatnonzero(~np.isfinite(found).all(axis=1))):
        raise ExportError(
            f"The feature {name} is too large for float32 in frame {int(wrong[0])}, leave the recording out: "
            f"{recording.path}"
        )
    return found


def _language(recording: CollectedRecording, options: ExportOptions) -> EpisodeLanguage:
    """The subtasks that somebody said, at the rows where they begin; nothing else is known."""
    if options.language is None:
        return EpisodeLanguage()
    said = [Statement(row=frame, kind="subtask", role="assistant", text=text) for frame, text in recording.subtasks]
    return episode_language(said, fps=recording.info.fps)


def _kept(recording: CollectedRecording, camera: str, numbers: NDArray[np.int64]) -> CodedVideo:
    settings = recording.video_settings(camera)
    lead = _lead(recording, camera, int(numbers[0]))
    block = recording.coded_pictures(camera).select(np.arange(numbers[0] - lead, numbers[-1] + 1, dtype=np.intp))
    codec = _MP4_CODECS.get(settings.codec, settings.codec)
    return CodedVideo.of_access_units(codec, settings.width, settings.height, block.joined(), block.lengths, lead)


def _transcoded(
    recording: CollectedRecording, camera: str, video: VideoConfig, numbers: NDArray[np.int64]
) -> CodedVideo:
    settings = recording.video_settings(camera)
    encoder = make_encoder(video=video, width=settings.width, height=settings.height, fps=recording.info.fps)
    units = [unit for picture in shown(recording, camera, numbers) for unit in encoder.encode(picture)]
    units += encoder.finish()
    lengths = [len(unit) for unit in units]
    return CodedVideo.of_access_units(encoder.settings.codec, settings.width, settings.height, b"".join(units), lengths)


def _sidecar_row(recording: CollectedRecording) -> dict[str, Any]:
    """What is known of the episode beside LeRobot's columns; what a simulated one has more is null."""
    info, outcome = recording.info, recording.outcome
    return {
        "source": recording.path.name,
        "run_episode_index": info.episode_index,
        "attempt": 0,
        "origin": to_json(info.origin),
        "frame_stride": 1,
        "success": None if outcome is None else outcome.success,
        "failure_reason": "cut off by a crash" if outcome is None else outcome.reason,
        "cameras": [
            {
                "name": camera.name,
                "width": camera.width,
                "height": camera.height,
                "intrinsics": None if camera.intrinsics is None else list(camera.intrinsics),
                "mount": camera.mount or None,
                "mount_from_camera": (
                    None if camera.mount_from_camera is None else camera.mount_from_camera.vector().tolist()
                ),
            }
            for camera in info.cameras
        ],
    }

"""The exceptions: pictures that cannot go into an mp4 file of LeRobot as they are and have to be coded anew."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np

from demorec.core.config import VideoConfig
from demorec.core.errors import ExportError
from demorec.datasets.episode import ExportCamera, ExportEpisode
from demorec.datasets.lerobot.mp4 import CodedVideo
from demorec.mcap import AnyRecording, VideoSettings
from demorec.mcap.video import make_encoder


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


def _lead(recording: AnyRecording, camera: str, number: int) -> int:
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


def coded_videos(
    episode: ExportEpisode, reasons: Mapping[ExportCamera, str], video: VideoConfig
) -> dict[str, CodedVideo]:
    """Camera feature -> its images, one a frame: the recorded packets wherever there is no reason to transcode."""
    recording = episode.recording
    recorded = recording.coded_pictures([camera.name for camera, reason in reasons.items() if not reason])
    videos = {}
    for camera, reason in reasons.items():
        settings = dataset_settings(episode, camera, video, reason)
        codec, size = mp4_codec(settings), (settings.width, settings.height)
        if reason:
            encoder = make_encoder(video=video, width=size[0], height=size[1], fps=episode.fps)
            units = [unit for image in episode.images(camera) for unit in encoder.encode(image)]
            units += encoder.finish()
            lengths = [len(unit) for unit in units]
            videos[camera.feature] = CodedVideo.of_access_units(codec, *size, b"".join(units), lengths)
            continue
        numbers = episode.numbers(camera)
        is_whole = _stride(episode) == 1
        lead = _lead(recording, camera.name, int(numbers[0])) if is_whole else 0
        block = recorded.pop(camera.name)
        if lead or len(block) != len(numbers):
            taken = np.arange(numbers[0] - lead, numbers[-1] + 1) if is_whole else numbers
            block = block.select(taken.astype(np.intp))
        coded = CodedVideo.of_access_units(codec, *size, block.joined(), block.lengths, lead)
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
    """The `info` of a camera feature: what LeRobot reads from a file, and how it was coded, null where unknown.

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

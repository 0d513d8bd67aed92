"""The exceptions: pictures that cannot go into an mp4 file of LeRobot as they are and have to be coded anew."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.config import VideoConfig
from demorec.errors import ExportError
from demorec.lerobot.mp4 import CodedVideo
from demorec.recording import Recording, VideoSettings
from demorec.recording.video import make_encoder


def reason_to_transcode(settings: VideoSettings, stride: int) -> str:
    """Why pictures cannot be taken over, in words; "" if they can.

    With frames left out, the others stay decodable only if they are all keyframes.
    """
    if settings.codec == "jpeg":
        return "jpeg pictures are no video"
    if stride > 1 and (settings.gop == 0 or stride % settings.gop):
        return f"every {_ordinal(stride)} frame is taken and every {_ordinal(settings.gop)} is a keyframe"
    return ""


def _ordinal(number: int) -> str:
    return {1: "1st", 2: "2nd", 3: "3rd"}.get(number, f"{number}th")


def dataset_settings(settings: VideoSettings, video: VideoConfig, *, stride: int) -> VideoSettings:
    """How the pictures are coded in the dataset: as recorded, or as they will be transcoded."""
    fps = settings.fps // stride
    if reason_to_transcode(settings, stride):
        return make_encoder(video=video, width=settings.width, height=settings.height, fps=fps).settings
    return VideoSettings(
        codec=settings.codec,
        encoder=settings.encoder,
        width=settings.width,
        height=settings.height,
        fps=fps,
        pix_fmt=settings.pix_fmt,
        gop=settings.gop if stride == 1 else 1,
        crf=settings.crf,
        preset=settings.preset,
        options=settings.options,
    )


def coded_videos(
    recording: Recording, cameras: Sequence[str], video: VideoConfig, rows: NDArray[np.intp]
) -> dict[str, CodedVideo]:
    """Camera -> its pictures for the frames `rows`: the recorded packets wherever that is possible."""
    stride = int(rows[1] - rows[0]) if len(rows) > 1 else 1
    reasons = {name: reason_to_transcode(recording.video_settings(name), stride) for name in cameras}
    recorded = recording.coded_pictures([camera for camera, reason in reasons.items() if not reason])
    videos = {}
    for camera, reason in reasons.items():
        settings = recording.video_settings(camera)
        size = settings.width, settings.height
        if reason:
            codec, units = _transcoded(recording, camera, video, rows, settings.fps // stride)
            videos[camera] = CodedVideo.of_access_units(codec, *size, b"".join(units), [len(unit) for unit in units])
            continue
        pictures = recorded[camera] if stride == 1 else recorded[camera].select(rows)
        coded = CodedVideo.of_access_units(settings.codec, *size, pictures.joined(), pictures.lengths)
        if stride > 1 and not coded.is_keyframe.all():
            raise ExportError(
                f"The recording says that every {_ordinal(settings.gop)} picture of camera {camera} is a keyframe, "
                f"but it is not so: {recording.path}"
            )
        videos[camera] = coded
    return videos


def _transcoded(
    recording: Recording, camera: str, video: VideoConfig, rows: NDArray[np.intp], fps: int
) -> tuple[str, list[bytes]]:
    settings = recording.video_settings(camera)
    encoder = make_encoder(video=video, width=settings.width, height=settings.height, fps=fps)
    codec = encoder.settings.codec
    wanted = set(rows.tolist())
    packets: list[bytes] = []
    for index, picture in enumerate(recording.images(camera)):
        if index in wanted:
            packets += encoder.encode(picture)
    packets += encoder.finish()
    return codec, packets


def video_info(settings: VideoSettings) -> dict[str, Any]:
    """The `info` of a camera feature: what LeRobot reads from a file, and how it was coded, null where unknown.

    LeRobot codes anew with these settings when it takes episodes out of a dataset, and takes its own for those that are
    null; a GOP of 0 it refuses.
    """
    preset = int(settings.preset) if settings.preset.isdigit() else settings.preset or None
    return {
        "video.height": settings.height,
        "video.width": settings.width,
        "video.codec": settings.codec,
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

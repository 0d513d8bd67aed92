"""The records of a collected episode that are not messages: what is known before the first frame, and how it ended."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping

from demorec.core.errors import RecordingError, in_words
from demorec.core.plain import to_json
from demorec.episode.external import COLLECTED_VERSION, EpisodeInfo
from demorec.episode.validity import from_description
from demorec.mcap.external.validity import what_is_wrong
from demorec.mcap.metadata import EXTERNAL, check_seal, sealed
from demorec.mcap.video import VideoSettings

_MOST_TOLD = 5


def external_metadata(info: EpisodeInfo, cameras: Mapping[str, VideoSettings]) -> dict[str, str]:
    """The record that makes an MCAP file a recording of a collected episode; the first few values are for people.

    The URDF is not in it but a message of its own; its SHA-256 is.
    """
    return sealed(
        {
            "instruction": info.instruction,
            "robot": info.robot,
            "episode_index": str(info.episode_index),
            "format_version": str(info.format_version),
            "urdf_sha256": urdf_sha256(info.urdf),
            "info": to_json(dataclasses.replace(info, urdf="")),
            "cameras": to_json(dict(cameras)),
        }
    )


def urdf_sha256(urdf: str) -> str:
    """SHA-256 (hex) of a URDF, "" of none."""
    return hashlib.sha256(urdf.encode()).hexdigest() if urdf else ""


def read_external_metadata(metadata: Mapping[str, str]) -> tuple[EpisodeInfo, dict[str, VideoSettings], str]:
    """Inverse of `collected_metadata`, with the SHA-256 of the URDF, which `info` lacks.

    Raises:
        RecordingError: It is damaged, or of an unknown format version.
    """
    check_seal(EXTERNAL, metadata)
    version = metadata.get("format_version", "")
    if version not in map(str, range(1, COLLECTED_VERSION + 1)):
        raise RecordingError(
            f"The recording of a collected episode has format version {version[:20] or 'none'}, this demorec reads 1 "
            f"to {COLLECTED_VERSION}: use the demorec that wrote it, or a newer one"
        )
    try:
        info = from_description(metadata["info"], EpisodeInfo)
        cameras = from_description(metadata["cameras"], dict[str, VideoSettings])
        wrong = what_is_wrong(info)
        for camera in info.cameras:
            video = cameras.get(camera.name)
            if video is None or (video.width, video.height) != (camera.width, camera.height):
                wrong.append(f"the video of the camera {camera.name!r} has another size")
            elif camera.kept and video.codec != camera.kept:
                wrong.append(f"the video of the camera {camera.name!r} is {video.codec}, not {camera.kept}")
        if wrong:
            raise ValueError("; ".join(wrong[:_MOST_TOLD]))
        return info, cameras, metadata["urdf_sha256"]
    except (KeyError, ValueError) as error:
        raise RecordingError(
            f"The recording's metadata is not that of a collected episode ({in_words(error)})"
        ) from error

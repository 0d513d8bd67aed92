"""The records of an episode that are not messages: what is known before the first frame, and how it ended.

MCAP protects messages with checksums, but not metadata records; each of ours carries its own.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping
from dataclasses import dataclass

from demorec.episode import FORMAT_VERSION, EpisodeInfo, Outcome
from demorec.errors import RecordingError
from demorec.plain import from_json, to_json
from demorec.recording.video import VideoSettings

EPISODE = "demorec.episode"
OUTCOME = "demorec.outcome"
RECOVERED = "demorec.recovered"
_CHECKSUM = "crc32"


@dataclass(frozen=True, kw_only=True)
class CameraStreams:
    """What was recorded of one camera.

    Attributes:
        video: Coding of the colour pictures.
        depth, segmentation: Whether these were recorded.
    """

    video: VideoSettings
    depth: bool = False
    segmentation: bool = False


def episode_metadata(info: EpisodeInfo, cameras: Mapping[str, CameraStreams]) -> dict[str, str]:
    """The record that makes an MCAP file a recording; the first few values are for people."""
    return _sealed(
        {
            "task": info.task,
            "instruction": info.instruction,
            "episode_index": str(info.episode_index),
            "attempt": str(info.attempt),
            "root_seed": str(info.root_seed),
            "format_version": str(info.format_version),
            "info": to_json(info),
            "cameras": to_json(dict(cameras)),
        }
    )


def outcome_metadata(outcome: Outcome) -> dict[str, str]:
    """The record that ends a complete recording."""
    return _sealed({"success": str(outcome.success).lower(), "outcome": to_json(outcome)})


def recovered_metadata(*, kept_frames: int) -> dict[str, str]:
    """The record of a recording that a crash cut off."""
    return _sealed({"kept_frames": str(kept_frames)})


def read_episode_metadata(metadata: Mapping[str, str]) -> tuple[EpisodeInfo, dict[str, CameraStreams]]:
    """Inverse of `episode_metadata`; RecordingError on damage or an unknown format version."""
    check_seal(EPISODE, metadata)
    version = metadata.get("format_version", "")
    if not version.isdigit() or not 1 <= int(version) <= FORMAT_VERSION:
        raise RecordingError(
            f"The recording has format version {version or 'none'}, this demorec reads 1 to {FORMAT_VERSION}: "
            "use the demorec that wrote it, or a newer one."
        )
    try:
        info = from_json(metadata["info"], EpisodeInfo)
        cameras = from_json(metadata["cameras"], dict[str, CameraStreams])
    except (KeyError, ValueError) as error:
        raise RecordingError(f"The recording's metadata is not that of format version {version} ({error}).") from error
    return info, cameras


def read_outcome_metadata(metadata: Mapping[str, str]) -> Outcome:
    """Inverse of `outcome_metadata`; RecordingError on damage."""
    check_seal(OUTCOME, metadata)
    try:
        return from_json(metadata["outcome"], Outcome)
    except (KeyError, ValueError) as error:
        raise RecordingError(f"The recording's outcome cannot be read ({error}).") from error


def _sealed(metadata: dict[str, str]) -> dict[str, str]:
    return {**metadata, _CHECKSUM: _checksum(metadata)}


def check_seal(name: str, metadata: Mapping[str, str]) -> None:
    """Raise RecordingError unless the metadata are as they were written."""
    if metadata.get(_CHECKSUM) != _checksum(metadata):
        raise RecordingError(f"The recording is damaged: the checksum of its metadata {name} does not match.")


def _checksum(metadata: Mapping[str, str]) -> str:
    content = {key: value for key, value in metadata.items() if key != _CHECKSUM}
    return f"{zlib.crc32(json.dumps(content, sort_keys=True).encode()):08x}"

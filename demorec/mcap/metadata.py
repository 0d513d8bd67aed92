"""The metadata records of a recording: the description before the first frame, and the outcome.

MCAP protects messages with checksums, but not metadata records, so each record here has a checksum among its values.
"""

from __future__ import annotations

import hashlib
import json
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace

from demorec.core.errors import RecordingError, describe_error
from demorec.core.plain import from_json, to_json
from demorec.episode.episode import Outcome
from demorec.episode.info import FORMAT_VERSION, EpisodeInfo
from demorec.episode.simulated import simulation_facts
from demorec.episode.validity import read_episode_info
from demorec.mcap.video import VideoSettings

EPISODE = "demorec.episode"
OUTCOME = "demorec.outcome"
RECOVERED = "demorec.recovered"
"""Metadata record of a recording that a crash cut off."""
_CHECKSUM = "crc32"


@dataclass(frozen=True, kw_only=True)
class CameraStreams:
    """The recorded streams of one camera; the images of a depth camera are its depth."""

    video: VideoSettings
    depth: bool = False
    segmentation: bool = False


def episode_metadata(info: EpisodeInfo, cameras: Mapping[str, CameraStreams]) -> dict[str, str]:
    """Build the record that makes an MCAP file a recording; its first values are for human readers."""
    return sealed(
        {
            "instruction": info.instruction,
            "robot": info.robot_name,
            "episode_index": str(info.episode_index),
            "attempt": str(info.attempt),
            **{key: str(value) for key, value in simulation_facts(info).items() if key in ("task", "root_seed")},
            "format_version": str(FORMAT_VERSION),
            "urdf_sha256": urdf_sha256(info.urdf),
            "info": to_json(replace(info, urdf="")),
            "cameras": to_json(cameras),
        }
    )


def urdf_sha256(urdf: str) -> str:
    """Compute SHA-256 (hex); "" if empty."""
    return hashlib.sha256(urdf.encode()).hexdigest() if urdf else ""


def outcome_metadata(outcome: Outcome) -> dict[str, str]:
    """Build the record that ends a complete recording."""
    success = "unknown" if outcome.success is None else str(outcome.success).lower()
    return sealed({"success": success, "outcome": to_json(outcome)})


def read_episode_metadata(metadata: Mapping[str, str]) -> tuple[EpisodeInfo, dict[str, CameraStreams], str]:
    """Parse the record of `episode_metadata`: info without URDF, cameras, and the URDF's SHA-256.

    RecordingError if the record is damaged, or has another format version.
    """
    check_seal(EPISODE, metadata)
    version = metadata.get("format_version", "")
    if version != str(FORMAT_VERSION):
        raise RecordingError(
            f"The recording has format version {version[:20] or 'none'}, but this demorec reads {FORMAT_VERSION}: "
            "use the demorec that wrote it, or a newer one"
        )
    try:
        info = read_episode_info(metadata["info"], simulated=False)
        cameras = from_json(metadata["cameras"], dict[str, CameraStreams])
        _check_cameras(info, cameras)
        return info, cameras, metadata["urdf_sha256"]
    except (KeyError, ValueError) as error:
        raise RecordingError(f"The recording's metadata is not valid ({describe_error(error)})") from error


def _check_cameras(info: EpisodeInfo, cameras: Mapping[str, CameraStreams]) -> None:
    if cameras and cameras.keys() != {camera.name for camera in info.cameras}:
        raise ValueError("the recorded cameras differ from the description")
    for camera in info.cameras if cameras else ():
        streams, video = cameras[camera.name], cameras[camera.name].video
        is_as_described = (video.width, video.height, video.fps) == (camera.width, camera.height, info.fps)
        if camera.kept:
            is_as_described = is_as_described and (video.codec, streams.depth) == (camera.kept, camera.is_depth)
        if not is_as_described or (not camera.kept and video.gop < 1):
            raise ValueError(f"the images of the camera {camera.name!r} differ from the description")


def read_outcome_metadata(metadata: Mapping[str, str]) -> Outcome:
    """Parse the record of `outcome_metadata`. Raises RecordingError if it is damaged."""
    check_seal(OUTCOME, metadata)
    try:
        outcome = from_json(metadata["outcome"], Outcome)
        if min(outcome.num_frames, outcome.num_retries, *outcome.drops.values(), 0) < 0:
            raise ValueError("a number of frames, retries or drops below 0")
    except (KeyError, ValueError) as error:
        raise RecordingError(f"The recording's outcome cannot be read ({describe_error(error)})") from error
    return outcome


def sealed(metadata: dict[str, str]) -> dict[str, str]:
    """Add the checksum that `check_seal` verifies."""
    return {**metadata, _CHECKSUM: _checksum(metadata)}


def check_seal(name: str, metadata: Mapping[str, str]) -> None:
    """Raise RecordingError unless the checksum matches the other values."""
    if metadata.get(_CHECKSUM) != _checksum(metadata):
        raise RecordingError(f"The recording is damaged: the checksum of its metadata {name} does not match")


def _checksum(metadata: Mapping[str, str]) -> str:
    content = {key: value for key, value in metadata.items() if key != _CHECKSUM}
    return f"{zlib.crc32(json.dumps(content, sort_keys=True).encode()):08x}"

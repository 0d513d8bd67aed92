"""The records of an episode that are not messages: what is known before the first frame, and how it ended.

MCAP protects messages with checksums, but not metadata records; each of ours carries its own.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from demorec.core.errors import RecordingError, describe_error
from demorec.core.plain import from_plain, to_json, to_plain
from demorec.episode.episode import Outcome
from demorec.episode.info import DEPTH_UNITS, EXTERNAL_VERSION, FORMAT_VERSION, EpisodeInfo
from demorec.episode.validity import from_description, read_episode_info
from demorec.mcap.video import VideoSettings

EPISODE = "demorec.episode"
EXTERNAL = "demorec.collected"
"""In place of EPISODE in recordings of episodes that demorec did not simulate."""
RECORDS = (EPISODE, EXTERNAL)
OUTCOME = "demorec.outcome"
RECOVERED = "demorec.recovered"
"""Of a recording that a crash cut off."""
_OUTCOME_KEYS: Mapping[str, Mapping[str, str]] = {
    EPISODE: {
        name: name
        for name in (
            "success", "checks", "failure_phase", "failure_reason", "num_frames", "num_retries", "final_state_digest"
        )
    },
    EXTERNAL: {"success": "success", "num_frames": "num_frames", "drops": "drops", "reason": "failure_reason"},
}  # fmt: skip
"""Record at the start -> key in that at the end -> field of `Outcome`."""
_CHECKSUM = "crc32"


@dataclass(frozen=True, kw_only=True)
class CameraStreams:
    """What was recorded of one camera.

    Attributes:
        video: Coding of the colour images.
        depth, segmentation: Whether these were recorded.
    """

    video: VideoSettings
    depth: bool = False
    segmentation: bool = False


def record_of(info: EpisodeInfo) -> str:
    """Name of the record that describes an episode: EPISODE where demorec simulated it, else EXTERNAL."""
    return EXTERNAL if info.simulation is None else EPISODE


def episode_metadata(info: EpisodeInfo, cameras: Mapping[str, CameraStreams]) -> dict[str, str]:
    """The record that makes an MCAP file a recording; the first few values are for people.

    A URDF is not in it but a message of its own; its SHA-256 is.
    """
    streams: dict[str, object] = dict(cameras)
    if info.simulation is None:
        about = {"robot": info.robot_name, "urdf_sha256": urdf_sha256(info.urdf)}
        streams = {name: camera.video for name, camera in cameras.items()}
    else:
        about = {"task": info.task, "attempt": str(info.attempt), "root_seed": str(info.root_seed)}
    return sealed(
        {
            "instruction": info.instruction,
            "episode_index": str(info.episode_index),
            **about,
            "format_version": str(info.format_version),
            "info": to_json(dataclasses.replace(info, urdf="")),
            "cameras": to_json(streams),
        }
    )


def urdf_sha256(urdf: str) -> str:
    """SHA-256 (hex) of a URDF, "" of none."""
    return hashlib.sha256(urdf.encode()).hexdigest() if urdf else ""


def plain_outcome(record: str, outcome: Outcome) -> dict[str, Any]:
    """An outcome as recordings with this record (EPISODE or EXTERNAL) have it, as plain data."""
    plain = to_plain(outcome)
    return {key: plain[name] for key, name in _OUTCOME_KEYS[record].items()}


def outcome_metadata(record: str, outcome: Outcome) -> dict[str, str]:
    """The record that ends a complete recording, of one that has this record at its start."""
    success = "unknown" if outcome.success is None else str(outcome.success).lower()
    return sealed({"success": success, "outcome": to_json(plain_outcome(record, outcome))})


def read_episode_metadata(
    record: str, metadata: Mapping[str, str]
) -> tuple[EpisodeInfo, dict[str, CameraStreams], str]:
    """Inverse of `episode_metadata`, with the SHA-256 of the URDF, which `info` lacks.

    Args:
        record: EPISODE or EXTERNAL, the name under which the metadata are there.
        metadata: Its values.

    Raises:
        RecordingError: It is damaged, or of an unknown format version.
    """
    check_seal(record, metadata)
    version, newest = metadata.get("format_version", ""), FORMAT_VERSION if record == EPISODE else EXTERNAL_VERSION
    if version not in map(str, range(1, newest + 1)):
        what = "The recording" if record == EPISODE else "The recording of an external episode"
        raise RecordingError(
            f"{what} has format version {version[:20] or 'none'}, this demorec reads 1 to {newest}: "
            "use the demorec that wrote it, or a newer one"
        )
    try:
        info = read_episode_info(metadata["info"], simulated=record == EPISODE)
        if str(info.format_version) != version:
            raise ValueError(f"its description is of format version {info.format_version}")
        if record == EPISODE:
            cameras = from_description(metadata["cameras"], dict[str, CameraStreams])
        else:
            videos = from_description(metadata["cameras"], dict[str, VideoSettings])
            cameras = {
                name: CameraStreams(video=video, depth=video.codec in DEPTH_UNITS) for name, video in videos.items()
            }
        _check_cameras(info, cameras)
        return info, cameras, metadata["urdf_sha256"] if record == EXTERNAL else ""
    except (KeyError, ValueError) as error:
        what = f"format version {version}" if record == EPISODE else "an external episode"
        raise RecordingError(f"The recording's metadata is not that of {what} ({describe_error(error)})") from error


def _check_cameras(info: EpisodeInfo, cameras: Mapping[str, CameraStreams]) -> None:
    """ValueError unless all cameras (of a simulation none, before the first frame) were recorded as `info` says."""
    is_simulated = info.simulation is not None
    if not cameras and is_simulated:
        return
    if cameras.keys() != {camera.name for camera in info.cameras}:
        raise ValueError("the recorded cameras are not those of the description")
    for camera in info.cameras:
        video = cameras[camera.name].video
        if (video.width, video.height) != (camera.width, camera.height) or (is_simulated and video.fps != info.fps):
            raise ValueError(f"the video of the camera {camera.name!r} has another size or rate than the description")
        if is_simulated and video.gop < 1:
            raise ValueError(f"the video of the camera {camera.name!r} has a GOP of {video.gop}")
        if camera.kept and video.codec != camera.kept:
            raise ValueError(f"the video of the camera {camera.name!r} is {video.codec}, not {camera.kept}")


def read_outcome_metadata(record: str, metadata: Mapping[str, str]) -> Outcome:
    """Inverse of `outcome_metadata`; RecordingError on damage."""
    check_seal(OUTCOME, metadata)
    names = _OUTCOME_KEYS[record]
    try:
        plain = from_description(metadata["outcome"], dict[str, Any])
        if unknown := plain.keys() - names.keys():
            raise ValueError(f"unknown fields {', '.join(sorted(unknown)[:5])[:80]}")
        outcome = from_plain({names[key]: value for key, value in plain.items()}, Outcome)
        if record == EPISODE and outcome.success is None:
            raise ValueError("it does not say whether the episode succeeded")
        if min(outcome.num_frames, outcome.num_retries, *outcome.drops.values(), 0) < 0:
            raise ValueError("a number of frames, retries or drops below 0")
    except (KeyError, ValueError) as error:
        raise RecordingError(f"The recording's outcome cannot be read ({describe_error(error)})") from error
    return outcome


def sealed(metadata: dict[str, str]) -> dict[str, str]:
    """The metadata with their checksum, which `check_seal` looks at."""
    return {**metadata, _CHECKSUM: _checksum(metadata)}


def check_seal(name: str, metadata: Mapping[str, str]) -> None:
    """Raise RecordingError unless the metadata are as they were written."""
    if metadata.get(_CHECKSUM) != _checksum(metadata):
        raise RecordingError(f"The recording is damaged: the checksum of its metadata {name} does not match")


def _checksum(metadata: Mapping[str, str]) -> str:
    content = {key: value for key, value in metadata.items() if key != _CHECKSUM}
    return f"{zlib.crc32(json.dumps(content, sort_keys=True).encode()):08x}"

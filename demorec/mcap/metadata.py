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

from demorec.core.errors import RecordingError, in_words
from demorec.core.plain import from_plain, to_json, to_plain
from demorec.episode.episode import FORMAT_VERSION, Outcome, SimulatedInfo
from demorec.episode.external import EXTERNAL_VERSION, EpisodeInfo
from demorec.episode.validity import find_problems, from_description, read_episode_info
from demorec.mcap.video import VideoSettings

EPISODE = "demorec.episode"
EXTERNAL = "demorec.collected"
"""In place of EPISODE in recordings of episodes that demorec did not simulate."""
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
_KNOWN_VERSIONS = tuple(str(version) for version in range(1, FORMAT_VERSION + 1))


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


def episode_metadata(info: SimulatedInfo, cameras: Mapping[str, CameraStreams]) -> dict[str, str]:
    """The record that makes an MCAP file a recording; the first few values are for people."""
    return sealed(
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


def plain_outcome(record: str, outcome: Outcome) -> dict[str, Any]:
    """An outcome as recordings with this record (EPISODE or EXTERNAL) have it, as plain data."""
    plain = to_plain(outcome)
    return {key: plain[name] for key, name in _OUTCOME_KEYS[record].items()}


def outcome_metadata(record: str, outcome: Outcome) -> dict[str, str]:
    """The record that ends a complete recording, of one that has this record at its start."""
    success = "unknown" if outcome.success is None else str(outcome.success).lower()
    return sealed({"success": success, "outcome": to_json(plain_outcome(record, outcome))})


def read_episode_metadata(metadata: Mapping[str, str]) -> tuple[SimulatedInfo, dict[str, CameraStreams]]:
    """Inverse of `episode_metadata`; RecordingError on damage or an unknown format version."""
    check_seal(EPISODE, metadata)
    version = metadata.get("format_version", "")
    if version not in _KNOWN_VERSIONS:
        raise RecordingError(
            f"The recording has format version {version[:20] or 'none'}, this demorec reads 1 to {FORMAT_VERSION}: "
            "use the demorec that wrote it, or a newer one"
        )
    try:
        info = read_episode_info(metadata["info"])
        if str(info.format_version) != version:
            raise ValueError(f"its description is of format version {info.format_version}")
        cameras = from_description(metadata["cameras"], dict[str, CameraStreams])
        _check_cameras(info, cameras)
    except (KeyError, ValueError) as error:
        raise RecordingError(
            f"The recording's metadata is not that of format version {version} ({in_words(error)})"
        ) from error
    return info, cameras


def _check_cameras(info: SimulatedInfo, cameras: Mapping[str, CameraStreams]) -> None:
    """ValueError unless all cameras of the scene (none, before the first frame) were recorded as it says."""
    if cameras and cameras.keys() != {camera.name for camera in info.scene.cameras}:
        raise ValueError("the recorded cameras are not those of the scene")
    for camera in info.scene.cameras if cameras else ():
        video = cameras[camera.name].video
        if (video.width, video.height, video.fps) != (camera.width, camera.height, info.fps):
            raise ValueError(f"the video of the camera {camera.name!r} has another size or rate than the scene")
        if video.gop < 1:
            raise ValueError(f"the video of the camera {camera.name!r} has a GOP of {video.gop}")


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
        raise RecordingError(f"The recording's outcome cannot be read ({in_words(error)})") from error
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


_MOST_TOLD = 5


def external_metadata(info: EpisodeInfo, cameras: Mapping[str, VideoSettings]) -> dict[str, str]:
    """The record that makes an MCAP file a recording of an external episode; the first few values are for people.

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
    """Inverse of `external_metadata`, with the SHA-256 of the URDF, which `info` lacks.

    Raises:
        RecordingError: It is damaged, or of an unknown format version.
    """
    check_seal(EXTERNAL, metadata)
    version = metadata.get("format_version", "")
    if version not in map(str, range(1, EXTERNAL_VERSION + 1)):
        raise RecordingError(
            f"The recording of an external episode has format version {version[:20] or 'none'}, this demorec reads 1 "
            f"to {EXTERNAL_VERSION}: use the demorec that wrote it, or a newer one"
        )
    try:
        info = from_description(metadata["info"], EpisodeInfo)
        cameras = from_description(metadata["cameras"], dict[str, VideoSettings])
        wrong = find_problems(info)
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
            f"The recording's metadata is not that of an external episode ({in_words(error)})"
        ) from error

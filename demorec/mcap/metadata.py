"""The records of an episode that are not messages: what is known before the first frame, and how it ended.

MCAP protects messages with checksums, but not metadata records; each of ours carries its own.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping
from dataclasses import dataclass

from demorec.core.errors import RecordingError, in_words
from demorec.core.plain import to_json
from demorec.episode.episode import FORMAT_VERSION, Outcome, SimulatedInfo
from demorec.episode.external import ExternalOutcome
from demorec.episode.validity import from_description, read_episode_info
from demorec.mcap.video import VideoSettings

EPISODE = "demorec.episode"
COLLECTED = "demorec.collected"
"""In place of EPISODE in the recordings of `demorec.mcap.external`."""
OUTCOME = "demorec.outcome"
RECOVERED = "demorec.recovered"
"""Of a recording that a crash cut off."""
_CHECKSUM = "crc32"
_KNOWN_VERSIONS = tuple(str(version) for version in range(1, FORMAT_VERSION + 1))


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


def outcome_metadata(outcome: Outcome | ExternalOutcome) -> dict[str, str]:
    """The record that ends a complete recording."""
    success = "unknown" if outcome.success is None else str(outcome.success).lower()
    return sealed({"success": success, "outcome": to_json(outcome)})


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


def read_outcome_metadata[O: Outcome | ExternalOutcome](metadata: Mapping[str, str], kind: type[O]) -> O:
    """Inverse of `outcome_metadata`, of such an outcome; RecordingError on damage."""
    check_seal(OUTCOME, metadata)
    try:
        outcome = from_description(metadata["outcome"], kind)
        is_ours = isinstance(outcome, Outcome)
        counts = [outcome.num_retries] if isinstance(outcome, Outcome) else outcome.drops.values()
        if min(outcome.num_frames, *counts, 0) < 0:
            raise ValueError(f"a number of frames or {'retries' if is_ours else 'drops'} below 0")
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

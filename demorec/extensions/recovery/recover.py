"""Recovery of a recording after a crash.

A file without its end has no index, but every complete chunk has a checksum. Chunks are read from the start until one
is truncated or damaged; the frames present in all streams up to there are kept.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from mcap.records import Metadata

from demorec.core.errors import ConfigError, RecordingError, resource_error, without_path
from demorec.core.files import MCAP_MAGIC, make_folder, open_regular
from demorec.episode.episode import frame_time_ns
from demorec.episode.info import EpisodeInfo
from demorec.extensions.recovery.scan import CutOffError, ScannedMessage, scan
from demorec.mcap import messages, metadata
from demorec.mcap.channels import TF, camera_topic, video_topic
from demorec.mcap.container import damage_as_recording_error
from demorec.mcap.part_file import PartFile
from demorec.mcap.recording import Recording, open_recording
from demorec.mcap.ros2 import DEFINITIONS
from demorec.mcap.streams import frame_streams

_KNOWN_TYPES = {*DEFINITIONS, messages.PROTOBUF_VIDEO}


@dataclass(frozen=True, kw_only=True)
class Recovered:
    """Result of a recovery."""

    path: Path
    num_frames: int  # number of frames kept
    is_complete: bool  # whether only the name was missing
    reason: str  # why reading stopped; "" if the file was complete


def recover(source: Path, target: Path, *, overwrite: bool = False) -> Recovered:
    """Write an indexed recording of all complete frames of `source`, which is not changed.

    Raises:
        ConfigError: `target` is `source`, or exists.
        RecordingError: No frame could be kept, or a file cannot be read or written.
    """
    if source.resolve() == target.resolve():
        raise ConfigError(f"The recovered recording needs a different name from the damaged one: {source}")
    try:
        survey = _survey(source)
    except RecordingError as error:
        raise RecordingError(f"{without_path(error, source)}: {source}") from error
    make_folder(target.parent)
    seen: Counter[str] = Counter()
    # The source may be at the usual path of an unfinished file.
    part = target.with_name(f"{target.name}.recovering")
    file = PartFile(target, part=part, overwrite=overwrite, is_worthless=lambda part: True)
    try:
        file.metadata(metadata.EPISODE, survey.episode)
        for item in _items(source):
            if isinstance(item, str):
                break
            if isinstance(item, ScannedMessage):
                channel = item.channel
                seen[channel.topic] += 1
                if survey.keeps(item, seen[channel.topic]) and channel.type in _KNOWN_TYPES:
                    file.log(channel.topic, channel.type, item.data, item.log_ns, latched=channel.has_qos)
            elif item is None:
                file.flush()
        if survey.outcome is not None:
            file.metadata(metadata.OUTCOME, survey.outcome)
        else:
            file.metadata(metadata.RECOVERED, metadata.sealed({"kept_frames": str(survey.num_frames)}))
        file.end()
        with Recording(part) as recording:
            recording.table()  # an unreadable recovered file would be worse than none
        file.publish()
    except BaseException:
        file.discard()  # everything in it is in the source
        raise
    return Recovered(
        path=target, num_frames=survey.num_frames, is_complete=survey.outcome is not None, reason=survey.reason
    )


def is_whole(source: Path) -> bool:
    """Check whether a recording opens, ended properly, and can be read to its end."""
    try:
        with open_recording(source) as recording:
            return recording.outcome is not None and bool(recording.digest())
    except RecordingError:
        return False


class _Survey(NamedTuple):
    """Complete content of a file."""

    episode: dict[str, str]  # its metadata
    outcome: dict[str, str] | None  # metadata of the outcome, if complete
    reason: str  # why reading stopped; "" if complete
    num_frames: int  # present in all streams
    keeps: Callable[[ScannedMessage, int], bool]  # whether a message belongs to them, given its number, from 1


def _items(source: Path) -> Iterator[ScannedMessage | Metadata | str | None]:
    """Yield the items of `scan`, and last, unless the file ends properly, a string with the reason."""
    try:
        with open_regular(source) as file:
            size = file.seek(0, 2)
            file.seek(0)
            if file.read(len(MCAP_MAGIC)) != MCAP_MAGIC:
                yield "the file is empty" if size == 0 else "the file is not an MCAP file"
                return
            with damage_as_recording_error(source):
                yield from scan(file)
    except OSError as error:
        unreadable = RecordingError(f"The file cannot be read ({error.strerror}): {source}")
        raise resource_error(error, source) or unreadable from error
    except RecordingError as error:
        cause = error.__cause__
        yield str(cause) if isinstance(cause, CutOffError) else "a record is damaged"


def _survey(source: Path) -> _Survey:
    """Read everything once to count the frames present in all streams; RecordingError if no frame is complete."""
    found: dict[str, dict[str, str]] = {}
    reason = ""
    counts: Counter[str] = Counter()
    for item in _items(source):
        if isinstance(item, str):
            reason = item
        elif isinstance(item, Metadata):
            metadata.check_seal(item.name, item.metadata)
            found[item.name] = item.metadata
        elif item is not None:
            counts[item.channel.topic] += 1
    if metadata.EPISODE in found:
        episode, outcome = found[metadata.EPISODE], found.get(metadata.OUTCOME)
        info, cameras, _ = metadata.read_episode_metadata(episode)
        num_frames, keeps = _whole_frames(info, counts, cameras)
        if outcome is not None and metadata.read_outcome_metadata(outcome).num_frames != num_frames:
            outcome = None
        reason = "" if outcome is not None else reason or "the end is missing"
        if num_frames:
            return _Survey(episode, outcome, reason, num_frames, keeps)
    raise RecordingError(
        f"Nothing can be recovered, since the file has no complete frame ({reason or 'no episode metadata'})"
    )


def _whole_frames(
    info: EpisodeInfo, counts: Counter[str], cameras: Mapping[str, metadata.CameraStreams]
) -> tuple[int, Callable[[ScannedMessage, int], bool]]:
    """Find the number of frames present in all streams, images included, and which messages belong to them."""
    topics = {stream.topic for stream in frame_streams(info) if not stream.is_dense}
    if info.simulation is None:  # images precede their frames
        num_frames = min(counts[topic] for topic in topics)
        topics.add(TF)
        return num_frames, lambda message, count: message.channel.topic not in topics or count <= num_frames
    for camera, streams in cameras.items():
        topics.add(video_topic(camera, streams.video.codec))
        topics |= {camera_topic(camera, kind) for kind in ("depth", "segmentation") if getattr(streams, kind)}
    num_frames = min(counts[topic] for topic in topics)
    last_ns = frame_time_ns(max(num_frames - 1, 0), info.fps)
    return num_frames, lambda message, count: message.log_ns <= last_ns

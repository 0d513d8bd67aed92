"""What a crash left of a recording, as an indexed recording.

A file without its end has no index, but every chunk in it is whole and has its checksum. They are read from the
front until one is cut off or damaged; what all streams have in common up to there are the frames that are kept.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from mcap.records import Metadata

from demorec.core.errors import ConfigError, RecordingError, resource_error, without_path
from demorec.core.files import MCAP_MAGIC, make_folder, open_regular
from demorec.episode.info import Origin
from demorec.mcap import messages, metadata
from demorec.mcap.container import damage_as_recording_error
from demorec.mcap.episode_layout import EpisodeLayout
from demorec.mcap.part_file import PartFile
from demorec.mcap.recording import Recording, open_recording
from demorec.mcap.ros2 import DEFINITIONS
from demorec.mcap.scan import CutOffError, ScannedMessage, scan

_KNOWN_TYPES = {*DEFINITIONS, messages.PROTOBUF_VIDEO}


@dataclass(frozen=True, kw_only=True)
class Recovered:
    """What was kept.

    Attributes:
        path: The indexed recording.
        num_frames: Kept.
        is_complete: Whether nothing was missing, only the name.
        reason: Why reading stopped, "" when the file was complete.
    """

    path: Path
    num_frames: int
    is_complete: bool
    reason: str


def recover(source: Path, target: Path, *, overwrite: bool = False) -> Recovered:
    """Write an indexed recording of all whole frames of `source`, which stays as it is.

    Raises:
        ConfigError: `target` is `source`, or is there already.
        RecordingError: Not one frame could be kept, or a file cannot be read or written.
    """
    if source.resolve() == target.resolve():
        raise ConfigError(f"The recovered recording needs another name than the damaged one: {source}")
    try:
        survey = _survey(source)
    except RecordingError as error:
        raise RecordingError(f"{without_path(error, source)}: {source}") from error
    make_folder(target.parent)
    seen: Counter[str] = Counter()
    # The usual place for an unfinished file is where the source may lie.
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
            recording.table()  # a recovered file that cannot be read would be worse than none
        file.publish()
    except BaseException:
        file.discard()  # it holds nothing that the source does not
        raise
    return Recovered(
        path=target,
        num_frames=survey.num_frames,
        is_complete=survey.outcome is not None,
        reason="" if survey.outcome is not None else survey.reason,
    )


def is_whole(source: Path) -> bool:
    """Whether a recording opens, ended in order, and can be read to its end."""
    try:
        with open_recording(source) as recording:
            return recording.outcome is not None and bool(recording.digest())
    except RecordingError:
        return False


def can_be_made_again(part: Path, *, origin: str | Origin) -> bool:
    """Whether an unfinished recording holds nothing yet, or was derived from the same thing in the same way.

    Args:
        part: What a crash left.
        origin: That of the recording that is about to be written in its place, as its info has it.
    """
    for item in _items(part):
        if isinstance(item, Metadata) and item.name == metadata.EPISODE:
            info, _, _ = metadata.read_episode_metadata(item.metadata)
            return info.origin == origin and origin not in ("", Origin())
        if isinstance(item, str):
            return item == "the end is missing"  # after nothing: the writer was killed before the first frame
        if item is not None:
            return False
    return True  # it ended in order, before the first frame


class _Survey(NamedTuple):
    """What is whole in a file.

    Attributes:
        episode: The metadata of what is recorded.
        outcome: Those of how it ended, where all of it is there.
        reason: Why reading stopped.
        num_frames: That all streams have in common.
        keeps: Whether a message belongs to these frames, given which message of its topic it is, from 1.
    """

    episode: dict[str, str]
    outcome: dict[str, str] | None
    reason: str
    num_frames: int
    keeps: Callable[[ScannedMessage, int], bool]


def _items(source: Path) -> Iterator[ScannedMessage | Metadata | str | None]:
    """What `scan` gives of a file, and last, unless it ends as it should, a string that says why reading stopped."""
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
    """Read everything once to learn how many frames all streams have in common; RecordingError when it is none."""
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
        num_frames, keeps = EpisodeLayout(info).whole_frames(counts, cameras)
        reason = reason or "the end is missing"
        if outcome is not None and metadata.read_outcome_metadata(outcome).num_frames != num_frames:
            outcome = None
        if num_frames:
            return _Survey(episode, outcome, reason, num_frames, keeps)
    raise RecordingError(f"Nothing can be recovered, the file holds no whole frame ({reason or 'no episode metadata'})")

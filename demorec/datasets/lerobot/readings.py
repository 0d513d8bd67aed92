"""Recordings read and prepared, in order, by this process or by several."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

from demorec.core.processes import available_cores, in_turn
from demorec.datasets.exported import exported
from demorec.datasets.lerobot.attempts import AttemptRecord
from demorec.datasets.lerobot.layout import DatasetFeature
from demorec.datasets.lerobot.options import ExportOptions
from demorec.datasets.lerobot.prepare import PreparedEpisode, dataset_features, prepare_episode, reasons_to_transcode
from demorec.datasets.options import ProgressCallback
from demorec.datasets.sources import ExportSource, Profile, goes_in, is_wanted
from demorec.episode.episode import Outcome
from demorec.mcap import open_recording

_BYTES_THAT_PAY = 1 << 30
"""Reading is so quick that starting processes pays from about a gigabyte of recordings on (benchmarks/export.py)."""
_AHEAD = 3
"""Recordings that each process may be ahead of the writer: bounds the memory."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Reading:
    """What came of one recording.

    Attributes:
        path: The recording.
        attempt: For the success rates.
        outcome: As recorded; None where the recording ends before it.
        prepared: The episode; None for a failed attempt that is left out, of which nothing that follows is read, so
            that an export does not fail for what it leaves out.
        profile: What must agree with all the others.
        features, fps, robot: Of a dataset made from it.
        transcoded: Cameras whose images had to be encoded anew, with the reason.
        is_simulated: Whether demorec simulated the episode.
    """

    path: Path
    attempt: AttemptRecord
    outcome: Outcome | None
    prepared: PreparedEpisode | None = None
    profile: Profile = field(default_factory=Profile)
    features: dict[str, DatasetFeature] = field(default_factory=dict)
    fps: int = 0
    robot: str = ""
    transcoded: tuple[str, ...] = ()
    is_simulated: bool = False


def read(source: ExportSource, options: ExportOptions) -> Reading | None:
    """Read one recording; None if its episode is not wanted (`is_wanted`).

    Raises:
        RecordingError: It is damaged.
        ExportError: It has no frames, or its fps is no multiple of the wanted one.
    """
    with open_recording(source.path) as recording:
        if not is_wanted(recording, options):
            return None
        attempt = AttemptRecord.of(recording)
        if not goes_in(source, recording, options):
            return Reading(path=source.path, attempt=attempt, outcome=recording.outcome)
        episode = exported(recording, options)
        reasons = reasons_to_transcode(episode)
        return Reading(
            path=source.path,
            attempt=attempt,
            outcome=recording.outcome,
            profile=Profile.of(episode),
            features=dataset_features(episode, options),
            fps=episode.fps,
            robot=recording.info.robot_name,
            transcoded=tuple(f"{camera.name}, {reason}" for camera, reason in reasons.items() if reason),
            is_simulated=episode.simulated is not None,
            prepared=prepare_episode(episode, options),
        )


def readings(
    sources: Sequence[ExportSource], options: ExportOptions, progress: ProgressCallback | None, *, aside: Path
) -> Iterator[Reading]:
    """Every wanted recording in order; several processes read ahead where that pays, and leave pictures in `aside`."""
    workers = options.workers or _workers_that_pay(sources, options)
    one = partial(read, options=options) if workers == 1 else partial(_read_aside, options=options, folder=aside)
    for done, reading in enumerate(in_turn(one, sources, workers, ahead=_AHEAD), start=1):
        if reading is not None:
            yield reading
        if progress is not None:
            progress(done, len(sources))


def _workers_that_pay(sources: Sequence[ExportSource], options: ExportOptions) -> int:
    transcodes = options.depth or options.fps is not None
    size = sum(source.path.stat().st_size for source in sources) * (20 if transcodes else 1)
    return min(available_cores(), 8) if size >= _BYTES_THAT_PAY else 1


def _read_aside(source: ExportSource, options: ExportOptions, folder: Path) -> Reading | None:
    """`read`, with the pictures in files: through a pipe they cost as much as all the rest."""
    reading = read(source, options)
    if reading is None or reading.prepared is None:
        return reading
    data = reading.prepared.data
    data = replace(data, videos={key: video.put_aside(folder) for key, video in data.videos.items()})
    return replace(reading, prepared=replace(reading.prepared, data=data))

"""One recording, as a report tells it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from demorec.errors import ConfigError, RecordingError, without_path
from demorec.recording import Recording
from demorec.report.content import Components, PhaseSpan, ReportedEpisode
from demorec.report.filmstrip import filmstrip
from demorec.report.histogram import Histogram
from demorec.runs.run_file import FAILED
from demorec.scene.episode import EpisodeColumns, EpisodeInfo
from demorec.scene.features import ACTION, STATE, action_names, action_vectors, observation_names, observation_vectors
from demorec.scene.sensed import ObservationRows


def read_recording(path: Path, root: Path, *, camera: str, strip_bytes: int) -> tuple[ReportedEpisode, Components]:
    """What a recording holds and the numbers of its frames, counted; one that is damaged is told as such.

    Args:
        path: The file.
        root: What is reported on, of which the file is part.
        camera: Whose pictures the filmstrip shows; "" for the first one.
        strip_bytes: How large the filmstrip may be; 0 for none.

    Raises:
        ConfigError: The recording has no such camera.
    """
    source = path.name if path == root else path.relative_to(root).as_posix()
    is_failed = path.parent.name == FAILED
    try:
        with Recording(path) as recording:
            return _read(recording, source, is_failed=is_failed, camera=camera, strip_bytes=strip_bytes)
    except RecordingError as error:
        return ReportedEpisode(name=path.stem, source=source, problem=without_path(error, path)), {}


def _read(
    recording: Recording, source: str, *, is_failed: bool, camera: str, strip_bytes: int
) -> tuple[ReportedEpisode, Components]:
    info, outcome = recording.info, recording.outcome
    if camera and camera not in recording.cameras:
        there = ", ".join(recording.cameras) or "none"
        raise ConfigError(f"There is no camera {camera!r}, the cameras are {there}: {recording.path}")
    strip = None
    if strip_bytes and recording.cameras:
        shown = camera or recording.cameras[0]
        strip = filmstrip(
            shown,
            recording.num_frames,
            lambda frames: recording.images_at(shown, frames),
            most_bytes=strip_bytes,
        )
    columns = recording.columns()
    attempt = f", attempt {info.attempt}" if is_failed or info.attempt else ""  # of one that failed, or after one
    episode = ReportedEpisode(
        name=f"episode {info.episode_index}{attempt}",
        source=source,
        problem="" if outcome is not None else "A crash cut the recording off; it was recovered.",
        instruction=info.instruction,
        success=None if outcome is None else outcome.success,
        failure_phase="" if outcome is None else outcome.failure_phase,
        failure_reason="" if outcome is None else outcome.failure_reason,
        num_frames=recording.num_frames,
        fps=info.fps,
        num_retries=0 if outcome is None else outcome.num_retries,
        seed=info.root_seed,
        phases=phase_spans(columns.phase),
        conditions=() if outcome is None else outcome.checks,
        filmstrip=strip,
        info=info,
    )
    return episode, _components(info, columns)


def phase_spans(phases: Sequence[str]) -> tuple[PhaseSpan, ...]:
    """The phases of T frames, in order."""
    spans, first = [], 0
    for name, frames in groupby(phases):
        end = first + sum(1 for _ in frames)
        spans.append(PhaseSpan(name=name, first=first, end=end))
        first = end
    return tuple(spans)


def _components(info: EpisodeInfo, columns: EpisodeColumns) -> Components:
    """State and action as an export with joint targets has them."""
    if not columns.num_frames:
        return {}
    state = observation_vectors(ObservationRows.of_columns(columns), info.robot, info.scene)[STATE]
    action = action_vectors(columns, info.scene, "joint")
    found: Components = {}
    for feature, names, values in (
        (STATE, observation_names(info.robot, info.scene)[STATE], state),
        (ACTION, action_names(info.robot, "joint"), action),
    ):
        count(found, feature, names, values)
    return found


def count(into: Components, feature: str, names: Iterable[str], values: NDArray[Any]) -> None:
    """Count the components of a feature (T, D), those that have names."""
    for name, column in zip(names, values.T, strict=False):
        into.setdefault((feature, name), Histogram()).add(column)


def merge(into: Components, found: Components) -> None:
    """Add what one episode counted to what all have."""
    for key, histogram in found.items():
        into.setdefault(key, Histogram()).merge(histogram)

"""One recording, as a report shows it."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

from demorec.errors import ConfigError, RecordingError, without_path
from demorec.recording import Recording
from demorec.report.content import Components, PhaseSpan, ReportedEpisode, count
from demorec.report.filmstrip import filmstrip
from demorec.runs.run_file import FAILED
from demorec.scene.features import ACTION, STATE, action_names, action_vectors, observation_names, observation_vectors
from demorec.scene.sensed import ObservationRows


def read_recording(path: Path, source: str, *, camera: str, strip_bytes: int) -> tuple[ReportedEpisode, Components]:
    """A recording and the values of its frames, counted; a damaged one is reported as such.

    Args:
        path: The file.
        source: Its name on the page.
        camera: Which images the filmstrip shows; "" for the first camera.
        strip_bytes: Size limit of the filmstrip; 0 for none.

    Raises:
        ConfigError: The recording has no such camera.
    """
    try:
        with Recording(path) as recording:
            return _read(recording, source, camera=camera, strip_bytes=strip_bytes)
    except RecordingError as error:
        return ReportedEpisode(name=path.stem, source=source, problem=without_path(error, path)), {}


def _read(recording: Recording, source: str, *, camera: str, strip_bytes: int) -> tuple[ReportedEpisode, Components]:
    info, outcome = recording.info, recording.outcome
    if camera and camera not in recording.cameras:
        there = ", ".join(recording.cameras) or "none"
        raise ConfigError(f"There is no camera {camera!r}, the cameras are {there}: {recording.path}")
    strip = None
    if strip_bytes and recording.cameras:
        shown = camera or recording.cameras[0]
        strip = filmstrip(
            shown, recording.num_frames, lambda frames: recording.images_at(shown, frames), max_bytes=strip_bytes
        )
    columns = recording.columns()
    is_failed = recording.path.parent.name == FAILED
    attempt = f", attempt {info.attempt}" if is_failed or info.attempt else ""
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
        phases=_phase_spans(columns.phase),
        conditions=() if outcome is None else outcome.checks,
        filmstrip=strip,
        info=info,
    )
    found: Components = {}
    if columns.num_frames:  # state and action as an export with joint targets has them
        state = observation_vectors(ObservationRows.of_columns(columns), info.robot, info.scene)[STATE]
        count(found, STATE, observation_names(info.robot, info.scene)[STATE], state)
        count(found, ACTION, action_names(info.robot, "joint"), action_vectors(columns, info.scene, "joint"))
    return episode, found


def _phase_spans(phases: Sequence[str]) -> tuple[PhaseSpan, ...]:
    """The phases of T frames, in order."""
    spans, first = [], 0
    for name, frames in groupby(phases):
        end = first + sum(1 for _ in frames)
        spans.append(PhaseSpan(name=name, first=first, end=end))
        first = end
    return tuple(spans)

"""Gather the content of a report from recordings or a LeRobot dataset."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from demorec.check.base import Finding
from demorec.cli.shared.output import size_in_words
from demorec.core.errors import ConfigError, ExportError, RecordingError, describe_error, resource_error, without_path
from demorec.episode.element_names import is_numbered
from demorec.episode.episode import Outcome
from demorec.episode.protocol import Episode
from demorec.episode.roles import NO_NAMES, NamedRoles, Roles, roles_of_recording
from demorec.extensions.datasets.folder import LeRobotFolder
from demorec.extensions.datasets.recording import DatasetRecording
from demorec.extensions.doctor.diagnosis import Diagnosis
from demorec.extensions.policies.statistics import Rate
from demorec.extensions.report.filmstrip import MAX_SHOWN, Filmstrip, filmstrip
from demorec.mcap import open_recording
from demorec.runs.find import EPISODE_FOLDERS, Found, PathKind, expect, expect_recordings
from demorec.runs.run_file import (
    FAILED,
    RUN_NAME,
    Attempt,
    DamagedRunFileError,
    GeneratedRun,
    RunFile,
    load_any_run_file,
)

State = Literal["unreadable", "failed", "flagged", "unknown", "succeeded"]
"""State of an episode. "flagged" is a success with a finding of a check."""
MAX_COMPONENTS = 64
"""Maximum components of state and action that are drawn."""
MAX_SAMPLES = 200
"""Maximum frames per episode from which a distribution is drawn, plus its extremes."""

Components = dict[tuple[Literal["state", "action"], str], list[NDArray[np.float32]]]
"""(role, component name) -> sampled values, one array per episode."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ReportedEpisode:
    """One attempt at one episode. Facts missing from the source are None or empty.

    Attributes:
        name: "episode 3", or "episode 3, attempt 0" for a failed one.
        source: Its file, relative to the path of the report.
        problem: Reason why it cannot be read, or why nothing was recorded.
        instruction: Text of the instruction.
        outcome: None if unknown.
        num_frames, fps: Length and frame rate.
        flags: Findings of checks, broken ones first.
        score: Score by the doctor; 1 for a good or unjudged episode.
        filmstrip: None without images, and for some successes in a long report.
    """

    name: str
    source: str = ""
    problem: str = ""
    instruction: str = ""
    outcome: Outcome | None = None
    num_frames: int = 0
    fps: int = 1
    flags: tuple[Finding, ...] = ()
    score: float = 1.0
    filmstrip: Filmstrip | None = None

    @property
    def success(self) -> bool | None:
        """None if unknown."""
        return None if self.outcome is None else self.outcome.success

    @property
    def state(self) -> State:
        """State in one word."""
        if self.success is False:
            return "failed"
        if self.problem:
            return "unreadable"
        if self.flags:
            return "flagged"
        return "unknown" if self.success is None else "succeeded"

    @property
    def failure(self) -> str:
        """Reason and phase of a failure; "" otherwise."""
        if self.outcome is None or self.outcome.success is not False:
            return ""
        reason, phase = self.outcome.failure_reason or "no reason recorded", self.outcome.failure_phase
        return f"{reason} in phase {phase}" if phase else reason


@dataclass(frozen=True, kw_only=True, eq=False)
class Report:
    """Content of a page.

    Attributes:
        title: Name of the run, recording or dataset.
        kind: Kind of the source, in words.
        facts: (name, value) of the summary.
        episodes: Every attempt, in order.
        distributions: Distributions of actions and states.
        diagnosis: Results of the checks; None if none were run.
        missing: Sentences about data missing from the source.
    """

    title: str
    kind: str
    facts: tuple[tuple[str, str], ...]
    episodes: tuple[ReportedEpisode, ...]
    distributions: Components
    diagnosis: Diagnosis | None
    missing: tuple[str, ...]


def add_motion(into: Components, roles: Roles, columns: Mapping[str, NDArray[Any]]) -> None:
    """Add samples of the state and the action of an episode: finite values, evenly spaced, and the extremes.

    Args:
        into: The components of all episodes.
        roles: Roles of its features.
        columns: Feature -> (T, D).
    """
    drawn: dict[Literal["state", "action"], tuple[str, ...]] = {"state": roles.state, "action": roles.action}
    for role, parts in drawn.items():
        names = roles.elements(parts)[:MAX_COMPONENTS]
        if is_numbered(names):
            names = tuple(f"component {name}" for name in names)
        values = np.hstack([columns[part] for part in parts]) if parts else np.zeros((0, 0))
        for name, column in zip(names, values.T, strict=False):
            finite = column[np.isfinite(column)]
            if len(finite):
                sampled = finite[:: -(-len(finite) // MAX_SAMPLES)]
                samples = np.array([*sampled, finite.min(), finite.max()], dtype=np.float32)
                into.setdefault((role, name), []).append(samples)


def success_rate(episodes: Sequence[ReportedEpisode]) -> Rate:
    """Success rate over the attempts with a known outcome."""
    known = [episode.success for episode in episodes if episode.success is not None]
    return Rate(successes=sum(known), trials=len(known))


_KINDS: Mapping[PathKind, str] = {
    "recording": "recording",
    "run": "run",
    "evaluation": "evaluation of a policy",
    "recordings": "folder of recordings",
}
_Progress = Callable[[int, int], None]


def gather(
    path: Path,
    *,
    camera: str = "",
    diagnosis: Diagnosis | None = None,
    named: NamedRoles = NO_NAMES,
    advance: _Progress = lambda done, total: None,
) -> Report:
    """Gather the content of a page about a recording, a run, an evaluation, a folder of recordings or a dataset.

    Args:
        path: Path of the source.
        camera: Camera of the filmstrips; "" for the first one.
        diagnosis: Results of the checks; None if none were run.
        named: Features whose role the user names, in data that demorec did not simulate.
        advance: Called with the number of read episodes and of all.

    Raises:
        ConfigError: There is nothing to report on, or the camera does not exist.
        ExportError: The dataset cannot be read.
    """
    found = expect(path, "recording", "dataset", *EPISODE_FOLDERS)
    if found.kind == "dataset":
        return _dataset_report(path, camera, diagnosis, named, advance)
    return _recordings_report(found, camera, diagnosis, named, advance)


def _recordings_report(
    found: Found, camera: str, diagnosis: Diagnosis | None, named: NamedRoles, advance: _Progress
) -> Report:
    files = (*found.recordings, *found.failed)
    expect_recordings(found, files)
    run, missing = _run_file(found)
    stride = -(-len(files) // MAX_SHOWN)
    components: Components = {}
    episodes: list[ReportedEpisode] = []
    for number, file in enumerate(files):
        has_strip = number % stride == 0 or file.parent.name == FAILED
        episode = _read(partial(open_recording, file), file, named, camera, has_strip, components)
        source = file.name if file == found.path else file.relative_to(found.path).as_posix()
        episodes.append(_judged(replace(episode, source=source), number, diagnosis))
        advance(len(episodes), len(files))
    if run is not None:
        episodes += [_without_recording(attempt) for attempt in run.attempts if not attempt.file]
    facts = [("attempts" if found.failed else "recordings", str(len(episodes)))]
    if isinstance(run, GeneratedRun):
        facts.insert(0, ("episodes", f"{len(run.successes)} of {run.num_episodes} asked"))
    facts += _common_facts(episodes, files)
    if run is not None:
        facts.append(("run digest", run.digest))
    return Report(
        title=found.path.resolve().name,
        kind=_KINDS[found.kind],
        facts=tuple(facts),
        episodes=tuple(episodes),
        distributions=components,
        diagnosis=diagnosis,
        missing=missing,
    )


def _dataset_report(
    root: Path, camera: str, diagnosis: Diagnosis | None, named: NamedRoles, advance: _Progress
) -> Report:
    folder = LeRobotFolder(root, named=named)
    stride = max(1, -(-len(folder.places) // MAX_SHOWN))
    flagged = set() if diagnosis is None else {finding.episode for finding in diagnosis.findings}
    without_videos = folder.leave_out_missing_cameras()
    components: Components = {}
    episodes: list[ReportedEpisode] = []
    for number, place in enumerate(folder.places):
        has_strip = number % stride == 0 or place.episode_index in flagged
        episode = _read(partial(_stored, folder, number), root, folder.roles, camera, has_strip, components)
        episode = replace(episode, name=f"episode {place.episode_index}")
        episodes.append(_judged(episode, place.episode_index, diagnosis))
        advance(len(episodes), len(folder.places))
    files = (file for file in root.rglob("*") if file.is_file())
    facts = [("episodes", str(len(episodes))), *_common_facts(episodes, files)]
    missing = [*folder.notes, *(f"No episode has a video of {key}." for key in without_videos), *folder.roles.notes()]
    return Report(
        title=root.resolve().name,
        kind="LeRobot dataset",
        facts=(*facts, ("format", f"LeRobot {folder.info.version}")),
        episodes=tuple(episodes),
        distributions=components,
        diagnosis=diagnosis,
        missing=tuple(missing),
    )


@contextmanager
def _stored(folder: LeRobotFolder, number: int) -> Iterator[Episode]:
    try:
        yield DatasetRecording(folder, number)
    except (ValueError, TypeError, KeyError, IndexError) as error:  # nulls and unexpected values in its tables
        raise ExportError(f"The dataset cannot be read ({describe_error(error)}): {folder.root}") from error


def _read(
    opened: Callable[[], AbstractContextManager[Episode]],
    path: Path,
    roles: Roles | NamedRoles,
    camera: str,
    has_strip: bool,
    components: Components,
) -> ReportedEpisode:
    """Read an episode and add its motion to the components; a damaged one is reported as damaged."""
    try:
        with opened() as episode:
            info, table = episode.info, episode.table()
            if camera and camera not in episode.cameras:
                there = ", ".join(episode.cameras) or "none"
                raise ConfigError(f"No camera {camera!r}, available are {there}: {path}")
            cameras = [name for name in episode.cameras if camera in ("", name) and len(table.image_stamps[name])]
            strip = None
            if has_strip and cameras:
                strip = filmstrip(cameras[0], episode.num_frames, partial(episode.images_at, cameras[0]))
            own_roles = roles if isinstance(roles, Roles) else roles_of_recording(info, roles)
            add_motion(components, own_roles, table.features)
            attempt = f", attempt {info.attempt}" if info.attempt or path.parent.name == FAILED else ""
            return ReportedEpisode(
                name=f"episode {info.episode_index}{attempt}",
                problem="A crash cut the recording off; it was recovered." if episode.outcome is None else "",
                instruction=info.instruction,
                outcome=episode.outcome,
                num_frames=episode.num_frames,
                fps=info.fps,
                filmstrip=strip,
            )
    except (RecordingError, ExportError) as error:
        if (lack := resource_error(error)) is not None:
            raise lack from error
        return ReportedEpisode(name=path.stem, problem=without_path(error, path))


def _judged(episode: ReportedEpisode, number: int, diagnosis: Diagnosis | None) -> ReportedEpisode:
    """Add the findings and the score of an episode."""
    if diagnosis is None:
        return episode
    flags = [finding for finding in diagnosis.findings if finding.episode == number]
    scores = [each.score for each in diagnosis.episodes if each.episode == number and each.verdict != "good"]
    flags.sort(key=lambda finding: finding.severity != "broken")
    return replace(episode, flags=tuple(flags), score=min(scores, default=1.0))


def _common_facts(episodes: Sequence[ReportedEpisode], files: Iterable[Path]) -> Iterator[tuple[str, str]]:
    rate = success_rate(episodes)
    if rate.trials:
        yield "success", f"{rate}"
    seconds = sum(episode.num_frames / episode.fps for episode in episodes)
    yield "frames", f"{sum(episode.num_frames for episode in episodes):,} ({seconds:.1f} s)"
    yield "size", size_in_words(sum(file.stat().st_size for file in files))


def _run_file(found: Found) -> tuple[RunFile | None, tuple[str, ...]]:
    """run.json, if readable, and sentences about missing data."""
    if found.kind != "run":
        return None, ()
    try:
        run = load_any_run_file(found.path)
    except DamagedRunFileError as error:
        reason = without_path(error, found.path / RUN_NAME)
        return None, (f"{reason}, so the requested number of episodes is not known.",)
    return run, ((f"{run.unfinished}.",) if run.unfinished else ())


def _without_recording(attempt: Attempt) -> ReportedEpisode:
    return ReportedEpisode(
        name=f"episode {attempt.episode_index}, attempt {attempt.attempt}",
        problem="Nothing was recorded, since no scene could be laid out.",
        outcome=Outcome(success=False, num_frames=0, failure_phase=attempt.phase, failure_reason=attempt.reason),
    )

"""Gather the content of a report: from recordings here, from datasets in `demorec.extensions.report.dataset`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from demorec.check.report import CheckOptions, Subject, SubjectReport, check_subject, find_subjects
from demorec.core.errors import ConfigError, RecordingError, without_path
from demorec.core.processes import in_turn
from demorec.episode.episode import Outcome, consecutive_runs
from demorec.episode.roles import NO_NAMES, NamedRoles, roles_of_recording
from demorec.episode.simulated import simulation_facts
from demorec.extensions.doctor.diagnosis import Diagnosis
from demorec.extensions.report.content import (
    CheckSummaries,
    Components,
    Report,
    ReportedEpisode,
    add_components,
    broken_first,
    common_facts,
    few,
    judged_episode,
    motion_components,
)  # fmt: skip
from demorec.extensions.report.dataset import dataset_report
from demorec.extensions.report.filmstrip import MAX_SHOWN, filmstrip, strip_budget
from demorec.mcap import Recording, open_recording
from demorec.runs.find import EPISODE_FOLDERS, Found, PathKind, expect, expect_recordings
from demorec.runs.run_file import (
    FAILED,
    RUN_NAME,
    Attempt,
    DamagedRunFileError,
    RunFile,
    is_external_run,
    load_any_run_file,
)

_KINDS: Mapping[PathKind, str] = {
    "recording": "recording",
    "run": "run",
    "evaluation": "evaluation of a policy",
    "recordings": "folder of recordings",
}
_Read = tuple[ReportedEpisode, Components, SubjectReport | None]
_AHEAD = 2
"""Maximum episodes that a process may be ahead of the count."""


def gather(
    path: Path,
    *,
    camera: str = "",
    checks: CheckOptions | None = None,
    judged: Diagnosis | None = None,
    workers: int = 1,
    named: NamedRoles = NO_NAMES,
    advance: Callable[[int, int], None] = lambda done, total: None,
) -> Report:
    """The content of a page about a recording, a run, an evaluation, a folder of recordings or a dataset.

    Args:
        path: Path of the source.
        camera: Camera of the filmstrips; "" for the first one.
        checks: Selected checks of files; None for none.
        judged: The doctor's diagnosis.
        workers: Number of processes that read and check recordings.
        named: Features whose role the user names, in data that demorec did not simulate.
        advance: Called with the number of finished items and of all items.

    Raises:
        ConfigError: There is nothing to report on, or the camera does not exist.
        ExportError: The dataset cannot be read.
    """
    found = expect(path, "recording", "dataset", *EPISODE_FOLDERS)
    if found.kind == "dataset":
        return dataset_report(path, camera, checks, judged, named, advance)
    return _recordings_report(found, camera, checks, judged, workers, named, advance)


def _recordings_report(
    found: Found,
    camera: str,
    checks: CheckOptions | None,
    judged: Diagnosis | None,
    workers: int,
    named: NamedRoles,
    advance: Callable[[int, int], None],
) -> Report:
    path = found.path
    run, missing = _run_file(found)
    later = set() if run is None else {path / attempt.file for attempt in run.beyond}
    if later:
        missing.append(f"{len(later)} recordings of episodes beyond the number last requested are left out.")
    subjects = [
        Subject(path=file, kind="recording") for file in (*found.recordings, *found.failed) if file not in later
    ]
    if not subjects:
        expect_recordings(found, ())
    folders = [s for s in find_subjects([path]) if s.kind != "recording"] if checks else []
    summaries = CheckSummaries()
    total = len(subjects) + len(folders)
    episodes: list[ReportedEpisode] = []
    components: Components = {}
    for number, (episode, found_in, checked) in enumerate(_read_all(path, camera, checks, subjects, workers, named)):
        episodes.append(judged_episode(episode, number, judged))
        add_components(components, found_in)
        if checked is not None:
            summaries.add(checked.results, episode.name)
        advance(len(episodes), total)
    if checks is None:
        missing.append("No checks were run (--no-checks).")
    else:
        for number, subject in enumerate(folders, len(subjects) + 1):
            summaries.add(check_subject(subject, checks).results, f"the {subject.kind}")
            advance(number, total)
        summaries.add_judged(judged)
        if not checks.images:
            missing.append("The checks that decode all images were not run; --images runs them, too.")
    if run is not None:
        episodes += [_without_recording(attempt) for attempt in run.attempts if not attempt.file]
    return Report(
        title=path.resolve().name,
        kind=_KINDS[found.kind],
        facts=tuple(_facts(found, run, episodes)),
        episodes=tuple(episodes),
        distributions=components,
        has_units=all(episode.seed is not None for episode in episodes if episode.facts),
        checks=summaries if checks else None,
        missing=tuple(missing),
    )


def _read_all(
    root: Path,
    camera: str,
    checks: CheckOptions | None,
    subjects: Sequence[Subject],
    workers: int,
    named: NamedRoles,
) -> Iterator[_Read]:
    stride = -(-len(subjects) // MAX_SHOWN)
    budget = strip_budget(len(subjects))
    strips = [0 if number % stride and s.path.parent.name != FAILED else budget for number, s in enumerate(subjects)]
    return in_turn(
        partial(_read, root, camera, checks, named), list(zip(subjects, strips, strict=True)), workers, ahead=_AHEAD
    )


def _read(root: Path, camera: str, checks: CheckOptions | None, named: NamedRoles, given: tuple[Subject, int]) -> _Read:
    """Read and check a recording, in any process, with a size limit for its strip; a damaged one is reported as
    damaged.
    """
    subject, strip_bytes = given
    checked = None if checks is None else check_subject(subject, checks)
    flags = broken_first(() if checked is None else checked.findings)
    path = subject.path
    source = path.name if path == root else path.relative_to(root).as_posix()
    try:
        with open_recording(path) as recording:
            episode = _read_recording(recording, camera, strip_bytes)
            components = motion_components(roles_of_recording(recording.info, named), recording.table().features)
    except RecordingError as error:
        episode, components = ReportedEpisode(name=path.stem, problem=without_path(error, path)), {}
    return replace(episode, source=source, flags=flags), components, checked


def _read_recording(recording: Recording, camera: str, strip_bytes: int) -> ReportedEpisode:
    info = recording.info
    if camera and camera not in recording.cameras:
        there = ", ".join(recording.cameras) or "none"
        raise ConfigError(f"No camera {camera!r}, available are {there}: {recording.path}")
    strip = None
    shown = next((name for name in recording.cameras if camera in ("", name) and recording.num_images(name)), None)
    if strip_bytes and shown is not None:
        strip = filmstrip(
            shown, recording.num_frames, lambda frames: recording.images_at(shown, frames), max_bytes=strip_bytes
        )
    is_failed = recording.path.parent.name == FAILED
    attempt = f", attempt {info.attempt}" if is_failed or info.attempt else ""
    return ReportedEpisode(
        name=f"episode {info.episode_index}{attempt}",
        problem="A crash cut the recording off; it was recovered." if recording.outcome is None else "",
        instruction=info.instruction,
        outcome=recording.outcome,
        num_frames=recording.num_frames,
        fps=info.fps,
        seed=simulation_facts(info).get("root_seed"),
        phases=tuple(consecutive_runs(recording.phases)),
        filmstrip=strip,
        facts=tuple(_facts_of(recording)),
    )


def _facts_of(recording: Recording) -> Iterator[tuple[str, str]]:
    info, simulated = recording.info, simulation_facts(recording.info)
    if simulated:
        yield "task", simulated["task"]
    yield "robot", info.robot_name
    videos = ((name, recording.video_settings(name)) for name in recording.cameras)
    yield "cameras", ", ".join(f"{name} {video.width}x{video.height}" for name, video in videos) or "none"
    if simulated:
        yield "root seed", str(simulated["root_seed"])
    yield "made with", f"demorec {info.versions.get('demorec', 'of an unknown version')}"


def _run_file(found: Found) -> tuple[RunFile | None, list[str]]:
    """run.json, if readable, and sentences about missing data."""
    if found.kind != "run":
        return None, []
    try:
        run = load_any_run_file(found.path)
        missing = [f"{run.unfinished}."] if run.unfinished else []
        return (None if run.generation is None else run), missing
    except DamagedRunFileError as error:
        return None, [
            f"{without_path(error, found.path / RUN_NAME)}, so the requested number of episodes is not known."
        ]


def _without_recording(attempt: Attempt) -> ReportedEpisode:
    return ReportedEpisode(
        name=f"episode {attempt.episode_index}, attempt {attempt.attempt}",
        problem="Nothing was recorded, since no scene could be laid out.",
        outcome=Outcome(
            success=False, checks=(), failure_phase=attempt.phase, failure_reason=attempt.reason, num_frames=0
        ),
        seed=attempt.seed,
    )


def _facts(found: Found, run: RunFile | None, episodes: Sequence[ReportedEpisode]) -> Iterator[tuple[str, str]]:
    if run is not None:
        yield "episodes", f"{len(run.successes)} of {run.num_episodes} asked"
    yield "attempts" if found.failed else "recordings", str(len(episodes))
    yield from common_facts(episodes, (*found.recordings, *found.failed))
    facts = [fact for episode in episodes for fact in episode.facts]
    for name in dict.fromkeys(name for name, _ in facts):
        yield name, few(value for of, value in facts if of == name)
    if run is not None:
        yield "variation", run.config.variation
        yield "run digest", run.digest
    elif found.kind == "run" and is_external_run(found.path):
        yield "run digest", load_any_run_file(found.path).digest

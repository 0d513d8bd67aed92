"""What a path holds, gathered for a report."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from demorec.check.report import CheckOptions, Subject, SubjectReport, check_subject, find_subjects
from demorec.errors import without_path
from demorec.evaluate.statistics import Rate
from demorec.lerobot.layout import DatasetInfo
from demorec.plain import to_plain
from demorec.processes import in_turn
from demorec.report.content import CheckSummaries, Components, Report, ReportedEpisode, flags_of
from demorec.report.episodes import MOST_SHOWN
from demorec.report.exported import missing_in, read_episodes, read_story
from demorec.report.filmstrip import strip_budget
from demorec.report.recorded import merge, read_recording
from demorec.runs.find import EPISODE_FOLDERS, Found, PathKind, expect, expect_recordings
from demorec.runs.run_file import RUN_NAME, Attempt, DamagedRunFileError, RunFile, load_run_file
from demorec.scene.episode import EpisodeInfo
from demorec.scene.features import IMAGE_PREFIX

_SHOWN = 3
"""Of several values of one fact."""
_KINDS: Mapping[PathKind, str] = {
    "recording": "recording",
    "run": "run",
    "evaluation": "evaluation of a policy",
    "recordings": "folder of recordings",
    "dataset": "LeRobot dataset",
}


@dataclass(frozen=True, kw_only=True)
class ReportOptions:
    """What goes into a report.

    Attributes:
        camera: Whose pictures the filmstrips show; "" for the first one.
        checks: Whether the checks are run.
        pictures: Whether those checks are run that decode all pictures.
        workers: Processes.
        allowed: The user's own modules beside which models of robots may be read.
    """

    camera: str = ""
    checks: bool = True
    pictures: bool = False
    workers: int = 1
    allowed: tuple[str, ...] = ()

    @property
    def of_checks(self) -> CheckOptions:
        """Those of the checks, of which one process runs one at a time."""
        return CheckOptions(pictures=self.pictures, workers=1, allowed=self.allowed)


def gather(path: Path, options: ReportOptions, advance: Callable[[int, int], None]) -> Report:
    """All that a page on a recording, a run, an evaluation, a folder of recordings or a dataset tells.

    Args:
        path: Of that.
        options: What goes into it.
        advance: Told how many things are done, of how many.

    Raises:
        ConfigError: There is nothing that can be reported on, or no such camera.
        ExportError: The dataset cannot be read.
    """
    found = expect(path, "recording", "dataset", *EPISODE_FOLDERS)
    if found.kind == "dataset":
        return _of_dataset(path, options, advance)
    return _of_recordings(found, options, advance)


_Done = tuple[ReportedEpisode, Components, SubjectReport | None]


def _do(root: Path, options: ReportOptions, given: tuple[Subject, int]) -> _Done:
    """Read and check a recording, in any process; beside it the bytes that its strip may take."""
    subject, strip_bytes = given
    checked = check_subject(subject, options.of_checks) if options.checks else None
    episode, components = read_recording(subject.path, root, camera=options.camera, strip_bytes=strip_bytes)
    return replace(episode, flags=() if checked is None else flags_of(checked)), components, checked


def _of_recordings(found: Found, options: ReportOptions, advance: Callable[[int, int], None]) -> Report:
    run, missing = _run_file(found)
    beyond = set() if run is None else {found.path / attempt.file for attempt in run.beyond}
    if beyond:
        missing.append(f"{len(beyond)} recordings of later episodes, of when more was asked for, are left out.")
    subjects = [
        *(Subject(path=path, kind="recording") for path in found.recordings if path not in beyond),
        *(Subject(path=path, kind="recording", is_failed_attempt=True) for path in found.failed if path not in beyond),
    ]
    if not subjects:
        expect_recordings(found, ())
    stride = -(-len(subjects) // MOST_SHOWN)
    budget = strip_budget(min(len(subjects), MOST_SHOWN))
    strips = [0 if number % stride and not s.is_failed_attempt else budget for number, s in enumerate(subjects)]
    wholes = [s for s in find_subjects([found.path]) if s.kind != "recording"] if options.checks else []
    checks = CheckSummaries()
    total = len(subjects) + len(wholes)
    episodes: list[ReportedEpisode] = []
    components: Components = {}
    for episode, counted, checked in in_turn(
        partial(_do, found.path, options), list(zip(subjects, strips, strict=True)), options.workers
    ):
        episodes.append(episode)
        merge(components, counted)
        if checked is not None:
            checks.add(checked.judged, episode.name)
        advance(len(episodes), total)
    for number, subject in enumerate(wholes, len(subjects) + 1):
        checks.add(check_subject(subject, options.of_checks).results, f"the {subject.kind}")
        advance(number, total)
    if run is not None:
        episodes += [_without_recording(attempt) for attempt in run.attempts if not attempt.file]
    if not options.checks:
        missing.append("No checks were run (--no-checks).")
    elif not options.pictures:
        missing.append("The checks that decode all pictures were not run; --pictures runs them, too.")
    return Report(
        title=found.path.resolve().name,
        kind=_KINDS[found.kind],
        facts=tuple(_facts(found, run, episodes)),
        episodes=tuple(episodes),
        distributions=components,
        has_units=True,
        checks=checks if options.checks else None,
        missing=tuple(missing),
        configs=_configs(episodes) if run is None else (to_plain(run.config),),
    )


def _run_file(found: Found) -> tuple[RunFile | None, list[str]]:
    """run.json where there is a good one, and what is to be said about it."""
    if found.kind != "run":
        return None, []
    try:
        return load_run_file(found.path), []
    except DamagedRunFileError as error:
        return None, [f"{without_path(error, found.path / RUN_NAME)}, so what was asked for is not known."]


def _without_recording(attempt: Attempt) -> ReportedEpisode:
    """An attempt for which no scene could be laid out."""
    return ReportedEpisode(
        name=f"episode {attempt.episode_index}, attempt {attempt.attempt}",
        problem="Nothing was recorded, since no scene could be laid out.",
        success=False,
        failure_phase=attempt.phase,
        failure_reason=attempt.reason,
        seed=attempt.seed,
    )


def _facts(found: Found, run: RunFile | None, episodes: Sequence[ReportedEpisode]) -> Iterator[tuple[str, str]]:
    infos = [episode.info for episode in episodes if episode.info is not None]
    if run is not None:
        yield "episodes", f"{len(run.successes)} of {run.num_episodes} asked"
    yield "attempts" if found.failed else "recordings", str(len(episodes))
    yield from _common_facts(episodes)
    for name, values in (
        ("task", (info.task for info in infos)),
        ("robot", (info.robot.name for info in infos)),
        ("cameras", (_cameras(info) for info in infos)),
        ("root seed", (str(info.root_seed) for info in infos)),
    ):
        yield name, _few(values)
    yield "size", size_text(sum(path.stat().st_size for path in (*found.recordings, *found.failed)))
    if run is not None:
        yield "variation", run.config.variation
        yield "run digest", run.digest
    yield "made with", _few(f"demorec {info.versions.get('demorec', 'of an unknown version')}" for info in infos)


def _cameras(info: EpisodeInfo) -> str:
    return ", ".join(f"{camera.name} {camera.width}x{camera.height}" for camera in info.scene.cameras) or "none"


def _common_facts(episodes: Sequence[ReportedEpisode]) -> Iterator[tuple[str, str]]:
    known = [episode for episode in episodes if episode.success is not None]
    if known:
        rate = Rate(successes=sum(bool(episode.success) for episode in known), trials=len(known))
        yield "success", f"{rate}"
    seconds = sum(episode.num_frames / episode.fps for episode in episodes)
    rates = _few(f"{episode.fps} Hz" for episode in episodes if episode.num_frames)
    yield "frames", f"{sum(episode.num_frames for episode in episodes):,} ({duration_text(seconds)} at {rates})"


def duration_text(seconds: float) -> str:
    """In the unit that reads best."""
    for unit, factor in (("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * factor:
            return f"{seconds / factor:.1f} {unit}"
    return f"{seconds:.1f} s"


def size_text(num_bytes: int) -> str:
    """In kB or MB."""
    return f"{num_bytes / 1000:.0f} kB" if num_bytes < 1_000_000 else f"{num_bytes / 1e6:.1f} MB"


def _few(values: Iterable[str]) -> str:
    """The distinct values, the first few of them."""
    distinct = list(dict.fromkeys(values))
    return (", ".join(distinct[:_SHOWN]) + (", ..." if len(distinct) > _SHOWN else "")) or "unknown"


def _configs(episodes: Sequence[ReportedEpisode]) -> tuple[Mapping[str, Any], ...]:
    """Of the episodes, each once."""
    found = {episode.info.config_digest: episode.info.config for episode in episodes if episode.info is not None}
    return tuple(found.values())


# --------------------------------------------------------------------------------------------------------- datasets


def _of_dataset(path: Path, options: ReportOptions, advance: Callable[[int, int], None]) -> Report:
    info = DatasetInfo.load(path)
    story = read_story(path)
    missing = list(missing_in(path, info, story))
    count = max(info.total_episodes, 1)
    components: Components = {}
    episodes: list[ReportedEpisode] = []
    for episode, counted in read_episodes(
        path,
        info,
        story,
        camera=options.camera,
        strip_bytes=strip_budget(min(count, MOST_SHOWN)),
        stride=-(-count // MOST_SHOWN),
    ):
        episodes.append(episode)
        merge(components, counted)
        advance(len(episodes), info.total_episodes + len(story.left_out) + options.checks)
    checks = CheckSummaries()
    if options.checks:
        report = check_subject(Subject(path=path, kind="dataset"), options.of_checks)
        checks.add(report.results, "the dataset")
        advance(len(episodes) + 1, len(episodes) + 1)
    else:
        missing.append("No checks were run (--no-checks).")
    return Report(
        title=path.resolve().name,
        kind=_KINDS["dataset"],
        facts=tuple(_dataset_facts(path, info, episodes, len(story.left_out))),
        episodes=tuple(episodes),
        distributions=components,
        has_units=bool(story.rows),
        checks=checks if options.checks else None,
        missing=tuple(missing),
        configs=tuple(story.configs.values()),
    )


def _dataset_facts(
    path: Path, info: DatasetInfo, episodes: Sequence[ReportedEpisode], left_out: int
) -> Iterator[tuple[str, str]]:
    yield "episodes", str(info.total_episodes)
    if left_out:
        yield "attempts", f"{len(episodes)}, of which {left_out} are not in the dataset"
    yield from _common_facts(episodes)
    yield "robot", info.robot_type or "unknown"
    cameras = (
        f"{key.removeprefix(IMAGE_PREFIX)} {'x'.join(str(n) for n in info.features[key].shape[1::-1])}"
        for key in info.video_keys
    )
    yield "cameras", ", ".join(cameras) or "none"
    yield "tasks", str(info.total_tasks)
    yield "size", size_text(sum(file.stat().st_size for file in path.rglob("*") if file.is_file()))
    yield "format", "LeRobot v3.0"

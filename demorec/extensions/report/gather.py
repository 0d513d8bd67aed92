"""Gather the content of a report from recordings or a LeRobot dataset."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from demorec.core.errors import ConfigError, ExportError, RecordingError, describe_error, without_path
from demorec.core.processes import in_turn
from demorec.core.replacing import shown
from demorec.datasets.lerobot.episode_places import EpisodePlace
from demorec.datasets.lerobot.folder import LeRobotFolder
from demorec.datasets.lerobot.inspect import noted
from demorec.datasets.lerobot.paths import SIDECAR_DIR
from demorec.episode.episode import Outcome, SuccessCheck, consecutive_runs
from demorec.episode.features import IMAGE_PREFIX
from demorec.episode.roles import NO_NAMES, NamedRoles, roles_of_recording
from demorec.episode.simulated import simulation_facts
from demorec.extensions.doctor.diagnosis import Diagnosis
from demorec.extensions.report.content import (
    MAX_COMPONENTS,
    Components,
    Report,
    ReportedEpisode,
    add_motion,
    success_rate,
)
from demorec.extensions.report.filmstrip import MAX_SHOWN, Filmstrip, filmstrip, strip_budget
from demorec.mcap import Recording, open_recording
from demorec.runs.find import EPISODE_FOLDERS, Found, PathKind, expect, expect_recordings
from demorec.runs.run_file import (
    FAILED,
    RUN_NAME,
    Attempt,
    DamagedRunFileError,
    RunFile,
    load_any_run_file,
)

_KINDS: Mapping[PathKind, str] = {
    "recording": "recording",
    "run": "run",
    "evaluation": "evaluation of a policy",
    "recordings": "folder of recordings",
}
_AHEAD = 2
"""Maximum episodes that a process may be ahead of the count."""
_SUCCESS = "next.success"
_SIDECAR_COLUMNS = (
    "source", "run_episode_index", "attempt", "root_seed", "success", "failure_phase",
    "failure_reason", "num_retries", "checks", "phases", "episode_info",
)  # fmt: skip
_Row = Mapping[str, Any]
_Progress = Callable[[int, int], None]


def gather(
    path: Path,
    *,
    camera: str = "",
    diagnosis: Diagnosis | None = None,
    workers: int = 1,
    named: NamedRoles = NO_NAMES,
    advance: _Progress = lambda done, total: None,
) -> Report:
    """Gather the content of a page about a recording, a run, an evaluation, a folder of recordings or a dataset.

    Args:
        path: Path of the source.
        camera: Camera of the filmstrips; "" for the first one.
        diagnosis: Results of the checks; None if none were run.
        workers: Number of processes that read recordings.
        named: Features whose role the user names, in data that demorec did not simulate.
        advance: Called with the number of read episodes and of all.

    Raises:
        ConfigError: There is nothing to report on, or the camera does not exist.
        ExportError: The dataset cannot be read.
    """
    found = expect(path, "recording", "dataset", *EPISODE_FOLDERS)
    if found.kind == "dataset":
        return _dataset_report(path, camera, diagnosis, named, advance)
    return _recordings_report(found, camera, diagnosis, workers, named, advance)


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
    unit, factor = ("h", 3600) if seconds >= 7200 else ("min", 60) if seconds >= 120 else ("s", 1)
    rates = _few(f"{episode.fps} Hz" for episode in episodes if episode.num_frames)
    yield "frames", f"{sum(episode.num_frames for episode in episodes):,} ({seconds / factor:.1f} {unit} at {rates})"
    size = sum(file.stat().st_size for file in files)
    yield "size", f"{size / 1000:.0f} kB" if size < 1_000_000 else f"{size / 1e6:.1f} MB"


def _few(values: Iterable[str]) -> str:
    """The first three distinct values."""
    return shown(list(dict.fromkeys(values)), 3) or "unknown"


def _recordings_report(
    found: Found, camera: str, diagnosis: Diagnosis | None, workers: int, named: NamedRoles, advance: _Progress
) -> Report:
    files = (*found.recordings, *found.failed)
    expect_recordings(found, files)
    run, missing = _run_file(found)
    stride = -(-len(files) // MAX_SHOWN)
    budget = strip_budget(len(files))
    strips = [0 if number % stride and file.parent.name != FAILED else budget for number, file in enumerate(files)]
    read = partial(_read, found.path, camera, named)
    episodes: list[ReportedEpisode] = []
    components: Components = {}
    beyond = () if run is None or run.generation is None else run.beyond
    unrequested = {found.path / attempt.file for attempt in beyond}
    if unrequested:
        missing += (f"{len(unrequested)} recordings of episodes beyond the number last requested are left out.",)
    wanted = [number for number, file in enumerate(files) if file not in unrequested]
    results = in_turn(read, [(files[number], strips[number]) for number in wanted], workers, ahead=_AHEAD)
    for number, (episode, own) in zip(wanted, results, strict=True):
        episodes.append(_judged(episode, number, diagnosis))
        for key, samples in own.items():
            components.setdefault(key, []).extend(samples)
        advance(len(episodes), len(wanted))
    if run is not None:
        episodes += [_without_recording(attempt) for attempt in run.attempts if not attempt.file]
    return Report(
        title=found.path.resolve().name,
        kind=_KINDS[found.kind],
        facts=tuple(_run_facts(found, run, episodes)),
        episodes=tuple(episodes),
        distributions=components,
        diagnosis=diagnosis,
        missing=missing,
    )


def _read(root: Path, camera: str, named: NamedRoles, given: tuple[Path, int]) -> tuple[ReportedEpisode, Components]:
    """Read a recording, in any process, with a size limit for its strip; a damaged one is reported as damaged."""
    path, strip_bytes = given
    components: Components = {}
    try:
        with open_recording(path) as recording:
            episode = _read_recording(recording, camera, strip_bytes)
            add_motion(components, roles_of_recording(recording.info, named), recording.table().features)
    except RecordingError as error:
        episode = ReportedEpisode(name=path.stem, problem=without_path(error, path))
    return replace(episode, source=path.name if path == root else path.relative_to(root).as_posix()), components


def _read_recording(recording: Recording, camera: str, strip_bytes: int) -> ReportedEpisode:
    info = recording.info
    if camera and camera not in recording.cameras:
        there = ", ".join(recording.cameras) or "none"
        raise ConfigError(f"No camera {camera!r}, available are {there}: {recording.path}")
    strip = None
    seen = next((name for name in recording.cameras if camera in ("", name) and recording.num_images(name)), None)
    if strip_bytes and seen is not None:
        strip = filmstrip(seen, recording.num_frames, partial(recording.images_at, seen), max_bytes=strip_bytes)
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
        outcome=_outcome({"success": False, "failure_phase": attempt.phase, "failure_reason": attempt.reason}),
        seed=attempt.seed,
    )


def _run_facts(found: Found, run: RunFile | None, episodes: Sequence[ReportedEpisode]) -> Iterator[tuple[str, str]]:
    if run is not None and run.generation is not None:
        yield "episodes", f"{len(run.successes)} of {run.num_episodes} asked"
    yield "attempts" if found.failed else "recordings", str(len(episodes))
    yield from _common_facts(episodes, (*found.recordings, *found.failed))
    facts = [fact for episode in episodes for fact in episode.facts]
    for name in dict.fromkeys(name for name, _ in facts):
        yield name, _few(value for of, value in facts if of == name)
    if run is not None:
        yield "run digest", run.digest


def _dataset_report(
    root: Path, camera: str, diagnosis: Diagnosis | None, named: NamedRoles, advance: _Progress
) -> Report:
    folder = LeRobotFolder(root, named=named)
    features, roles = folder.info.features, folder.roles
    rows = {row["episode_index"]: row for row in folder.sidecar(_SIDECAR_COLUMNS)}
    key = _camera_key(folder, camera)
    wanted = dict.fromkeys((*roles.state, *roles.action))
    if _SUCCESS in features and features[_SUCCESS].column.elements:
        wanted[_SUCCESS] = None
    reader = folder.rows(list(wanted)) if wanted else None
    stride, budget = max(1, -(-len(folder.places) // MAX_SHOWN)), strip_budget(len(folder.places))
    flagged = set() if diagnosis is None else {finding.episode for finding in diagnosis.findings}
    components: Components = {}
    episodes: list[ReportedEpisode] = []
    for number, place in enumerate(folder.places):
        columns: Mapping[str, NDArray[Any]] = {}
        strip: Filmstrip | None = None
        problems: list[str] = []
        with noted(problems, root):
            columns = {} if reader is None else reader.numbers(place)
            add_motion(components, roles, columns)
            if key is not None and (place.episode_index in flagged or number % stride == 0):
                stored = folder.stored_images.get(key)
                images_at = partial(stored.read, place) if stored else folder.video(key, place).images_at
                strip = filmstrip(key.removeprefix(IMAGE_PREFIX), place.length, images_at, max_bytes=budget)
        episode = _dataset_episode(place, int(folder.info.fps), columns, rows.get(place.episode_index))
        episode = replace(episode, filmstrip=strip, problem="; ".join(problems))
        episodes.append(_judged(episode, place.episode_index, diagnosis))
        advance(len(episodes), len(folder.places))
    episodes += [_left_out(row) for row in folder.attempts.failures]
    return Report(
        title=root.resolve().name,
        kind="LeRobot dataset",
        facts=tuple(_dataset_facts(folder, episodes)),
        episodes=tuple(episodes),
        distributions=components,
        diagnosis=diagnosis,
        missing=(*folder.notes, *_missing(folder, has_sidecar=bool(rows))),
    )


def _camera_key(folder: LeRobotFolder, camera: str) -> str | None:
    """The feature whose images are shown; None for a dataset without color images.

    Raises:
        ConfigError: The camera does not exist.
    """
    keys = [key for key, feature in folder.info.features.items() if feature.is_camera and not feature.is_depth]
    if not camera:
        return keys[0] if keys else None
    for key in keys:
        if camera in (key, key.removeprefix(IMAGE_PREFIX)):
            return key
    there = ", ".join(key.removeprefix(IMAGE_PREFIX) for key in keys) or "none"
    raise ConfigError(f"No camera {camera!r} with color images, available are {there}: {folder.root}")


def _dataset_episode(
    place: EpisodePlace, fps: int, columns: Mapping[str, NDArray[Any]], row: _Row | None
) -> ReportedEpisode:
    name = f"episode {place.episode_index}"
    known = ReportedEpisode(name=name, instruction=", ".join(place.tasks), num_frames=place.length, fps=fps)
    if row is None:
        success = bool(columns[_SUCCESS][-1, 0]) if len(columns.get(_SUCCESS, ())) else None
        return replace(known, outcome=_outcome({"success": success}))
    try:
        known = replace(known, source=str(row["source"]), outcome=_outcome(row))
        if row["episode_info"] is None:  # without a scene there is no seed and no phase
            return known
        phases = tuple((phase["name"], phase["from"], phase["to"]) for phase in row["phases"])
        return replace(known, seed=row["root_seed"], phases=phases)
    except (ValueError, KeyError, TypeError) as error:
        raise ExportError(f"The sidecar's row of {name} cannot be used ({describe_error(error)})") from error


def _outcome(row: _Row) -> Outcome | None:
    """Outcome of an attempt, as far as a row records it."""
    if row["success"] is None:
        return None
    return Outcome(
        success=row["success"],
        checks=tuple(SuccessCheck(**check) for check in row.get("checks") or ()),
        failure_phase=row.get("failure_phase") or "",
        failure_reason=row.get("failure_reason") or "",
        num_frames=0,
        num_retries=row.get("num_retries") or 0,
    )


def _left_out(row: _Row) -> ReportedEpisode:
    return ReportedEpisode(
        name=f"run's episode {row['run_episode_index']}, attempt {row['attempt']}",
        problem="This attempt is not in the dataset; only its outcome is known.",
        outcome=_outcome(row),
    )


def _missing(folder: LeRobotFolder, *, has_sidecar: bool) -> Iterator[str]:
    """Sentences about data missing from the dataset."""
    if not has_sidecar:
        yield (
            f"The dataset has no folder {SIDECAR_DIR}/, which exports of demorec have: random seeds, phases "
            "and the conditions of success are not known."
        )
        if _SUCCESS not in folder.info.features:
            yield f"Without a column {_SUCCESS}, the outcomes of the episodes are not known."
    if _camera_key(folder, "") is None:
        yield "It has no color images, so there are no filmstrips."
    roles = folder.roles
    yield from roles.notes()
    for role, parts in (("state", roles.state), ("action", roles.action)):
        if (count := len(roles.elements(parts))) > MAX_COMPONENTS:
            yield f"Only the first {MAX_COMPONENTS} of the {count} components of the {role} are drawn."


def _dataset_facts(folder: LeRobotFolder, episodes: Sequence[ReportedEpisode]) -> Iterator[tuple[str, str]]:
    yield "episodes", str(len(folder.places))
    if left_out := len(episodes) - len(folder.places):
        yield "attempts", f"{len(episodes)}, of which {left_out} are not in the dataset"
    yield from _common_facts(episodes, (file for file in folder.root.rglob("*") if file.is_file()))
    info = folder.info
    yield "robot", info.robot_type or "unknown"
    cameras = (
        f"{key.removeprefix(IMAGE_PREFIX)} {'x'.join(str(n) for n in feature.shape[1::-1])}"
        for key, feature in info.features.items()
        if feature.is_camera
    )
    yield "cameras", ", ".join(cameras) or "none"
    yield "tasks", str(info.total_tasks)
    yield "format", f"LeRobot {info.version}"

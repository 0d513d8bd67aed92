"""`demorec info`: show the content of a recording, a run or a dataset."""

from __future__ import annotations

import pkgutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from demorec.cli.shared import role_lines
from demorec.cli.shared.output import aligned, counted, say, say_json, size_in_words
from demorec.cli.shared.paths import MappingFile, Readable, need_paths, reading
from demorec.cli.shared.roles import NamedByFlags, RoleFlags
from demorec.core.errors import ConfigError, ExportError, RecordingError, describe_error, resource_error, without_path
from demorec.core.extensions import reader_rows
from demorec.datasets.lerobot.paths import INFO_PATH
from demorec.episode.features import IMAGE_PREFIX
from demorec.episode.simulated import simulation_facts
from demorec.runs.find import Found, expect, find
from demorec.runs.foreign import dropped_by_import

if TYPE_CHECKING:
    from demorec.datasets.lerobot.folder import LeRobotFolder
    from demorec.episode.roles import NamedRoles, Roles
    from demorec.runs.run_file import RunFile

_MOST_PROBLEMS = 5
"""Maximum problems of a dataset that are listed one by one."""
_SUCCESS_WORDS = {None: "unknown", True: "success", False: "failure"}


@dataclass(frozen=True, kw_only=True)
class Info:
    """Show the content of each path.

    Examples:
      demorec info recordings/cubes
      demorec info recordings/cubes/episodes/episode_000000.mcap
      demorec info datasets/cubes --json
    """

    paths: Readable
    mapping: MappingFile = None
    json: bool = False
    """Print JSON: one object, or a list for several paths."""
    roles: NamedByFlags = field(default_factory=RoleFlags)

    def run(self) -> int:
        """Read and print; 1 if one of several paths cannot be read."""
        need_paths(self.paths, "info")
        named = self.roles.named
        described = {} if self.mapping is not None or named else _described(self.paths)
        others = [path for path in self.paths if path not in described]
        with reading(others, self.mapping) as read:
            places = dict(zip(others, read, strict=True))
            self._show([_describe(places[path], named) if path in places else described[path] for path in self.paths])
        return 0

    def _show(self, found: Sequence[tuple[dict[str, Any], list[str]]]) -> None:
        if self.json:
            plain = [item for item, _ in found]
            say_json(plain[0] if len(plain) == 1 else plain)
        else:
            for number, (_, lines) in enumerate(found):
                say(*([""] if number else []), *lines)


def _described(paths: Sequence[Path]) -> dict[Path, tuple[dict[str, Any], list[str]]]:
    """Describe foreign files that need no import for it."""
    forms = reader_rows()
    kinds = {path: find(path).kind for path in paths}
    hooks = {path: forms[kind].describer for path, kind in kinds.items() if kind in forms}
    return {path: pkgutil.resolve_name(hook)(path) for path, hook in hooks.items() if hook}


def _describe(path: Path, named: NamedRoles) -> tuple[dict[str, Any], list[str]]:
    """Plain data for --json, and lines for the terminal."""
    found = expect(path, "recording", "run", "dataset", "recordings", "evaluation")
    describe = {"recording": _recording, "run": _run, "dataset": _dataset}.get(found.kind)
    if describe is None and named:
        raise ConfigError(f"--state, --action and --gripper are for a recording, a run or a dataset: {path}")
    plain, lines = _folder(found) if describe is None else describe(path, named)
    if found.unfinished:
        plain["unfinished"] = [str(file) for file in found.unfinished]
        lines += ["", f"Left out: {found.left}."]
    return plain, lines


def _recording(path: Path, named: NamedRoles) -> tuple[dict[str, Any], list[str]]:
    from demorec.mcap.summary import summarize

    plain = summarize(path, named)
    form = f"{'external, ' if plain['task'] is None else ''}format {plain['format_version']}"
    rate = f", {plain['rate']:.2f} Hz (nominal {plain['fps']} Hz)"
    if plain["physics_hz"] is not None:
        rate = f" at {plain['fps']} Hz (physics {plain['physics_hz']} Hz)"
    facts = [
        ("recording", f"{path} ({size_in_words(plain['bytes'])}, {form})"),
        ("instruction", plain["instruction"]),
        ("episode", _episode(plain)),
        ("outcome", _outcome(plain)),
        ("length", f"{plain['frames']} frames, {plain['seconds']:.2f} s{rate}"),
        ("robot", plain["robot"] + (" (URDF known)" if plain["has_urdf"] else "")),
    ]
    if plain["task"] is not None:
        facts.append(("objects", ", ".join(plain["objects"]) or "none"))
    if origin := plain["origin"]:
        facts.append(("origin", origin if isinstance(origin, str) else _origin(origin)))
    facts += role_lines.recording_features(plain["features"])
    facts += [(f"camera {camera['name']}", ", ".join(_camera(camera))) for camera in plain["cameras"]]
    facts += [(f"dropped {what}", str(count)) for what, count in plain["drops"].items()]
    for check in plain["checks"]:
        verdict = "passed" if check["passed"] else "FAILED"
        value = f"{check['value']:.4g} {check['unit']}".rstrip()
        facts.append((f"check {check['name']}", f"{verdict}: {value} (limit {check['limit']:.4g})"))
    facts.append(("digest", plain["digest"][:16]))
    versions = ", ".join(f"{name} {version}" for name, version in plain["versions"].items())
    facts.append(("made with", versions or "unknown"))
    streams = [(stream["topic"], str(stream["messages"]), stream["type"]) for stream in plain["streams"]]
    return plain, [*aligned(facts), "", *aligned([("topic", "messages", "type"), *streams])]


def _episode(plain: Mapping[str, Any]) -> str:
    if plain["task"] is None:
        return str(plain["episode_index"])
    attempt = f", attempt {plain['attempt']}" if plain["attempt"] else ""
    return f"{plain['task']}, seed {plain['root_seed']}, episode {plain['episode_index']}{attempt}"


def _outcome(plain: Mapping[str, Any]) -> str:
    reason = plain["failure_reason"]
    if plain["is_recovered"]:
        return "unknown: recovered after a crash"
    if plain["task"] is None:
        return _SUCCESS_WORDS[plain["success"]] + (f": {reason}" if reason else "")
    retries = f" after {plain['retries']} retries" if plain["retries"] else ""
    if plain["success"]:
        return f"success{retries}"
    return f"failure in phase {plain['failure_phase'] or 'unknown'}: {reason or 'unknown'}{retries}"


def _origin(origin: Mapping[str, Any]) -> str:
    return " ".join([origin["kind"], *(file["name"] for file in origin["files"])])


def _camera(camera: Mapping[str, Any]) -> Iterator[str]:
    video = camera["video"]
    yield f"{video['width']}x{video['height']} {video['codec']}{' as it came' if camera['is_kept'] else ''}"
    if video["crf"] is not None:
        yield f"GOP {video['gop']}, crf {video['crf']}"
    elif video["jpeg_quality"] is not None:
        yield f"quality {video['jpeg_quality']}"
    yield from (name for name in ("depth", "segmentation") if camera[name])
    yield counted(camera["images"], "image")
    yield f"at most {1000 * camera['oldest']:.3g} ms old"
    if camera["frames_without"]:
        yield f"{counted(camera['frames_without'], 'frame')} without"
    if camera["source"]:
        yield camera["source"]


def _run(path: Path, named: NamedRoles) -> tuple[dict[str, Any], list[str]]:
    from demorec.runs.run_file import load_any_run_file

    run = load_any_run_file(path)
    known = {"path": str(path), "complete": run.is_complete, "digest": run.digest}
    if run.generation is None:
        left_out = dropped_by_import(path)
        roles = role_lines.roles_of_run(path, run, named)
        plain = {"kind": "external run", **known, **run.plain()}
        plain |= {"roles": None if roles is None else role_lines.roles_as_plain(roles), "left_out": left_out}
        lines = _external_run_lines(path, run, roles)
        if left_out:
            rows = ((row["bag"], row["what"], row["reason"]) for row in left_out)
            lines += ["", *aligned([("left out of", "what", "reason"), *rows])]
        return plain, lines
    if named:
        from demorec.episode.roles import SIMULATED_ROLES

        raise ConfigError(SIMULATED_ROLES)
    return {"kind": "run", **known, "config_digest": run.config_digest, **run.plain()}, _run_lines(path, run)


def _run_lines(path: Path, run: RunFile) -> list[str]:
    config = run.config
    frames = sum(attempt.num_frames for attempt in run.attempts)
    cameras = f"{', '.join(config.cameras)} at {config.width}x{config.height}, {config.video.codec}"
    failed = f", {counted(len(run.failures), 'failed attempt')}" if run.failures else ""
    facts = [
        ("run", f"{path} ({'complete' if run.is_complete else 'unfinished'})"),
        ("task", f"{config.task} with {config.robot}, seed {config.seed}"),
        ("episodes", f"{len(run.successes)} of {run.num_episodes}{failed}"),
        ("frames", f"{frames} ({frames / config.fps:.1f} s at {config.fps} Hz)"),
        ("size", size_in_words(sum(attempt.num_bytes for attempt in run.attempts))),
        ("cameras", cameras if config.cameras else "none"),
        ("digest", run.digest),
    ]
    if run.beyond:
        facts.append(("beyond these", f"{len(run.beyond)} attempts at later episodes, requested earlier"))
    if run.export is not None:
        facts.append(("dataset", f"{path / 'dataset'} ({run.export.repo_id})"))
    rows = [("episode", "attempt", "outcome", "frames", "size", "file")]
    rows += [
        (
            str(attempt.episode_index),
            str(attempt.attempt),
            "success" if attempt.success else f"{attempt.phase}: {attempt.reason}",
            str(attempt.num_frames),
            size_in_words(attempt.num_bytes),
            attempt.file or "(no scene)",
        )
        for attempt in run.attempts
    ]
    return [*aligned(facts), "", *aligned(rows)]


def _external_run_lines(path: Path, run: RunFile, roles: Roles | None) -> list[str]:
    """Lines about an external run."""
    frames = sum(line.num_frames for line in run.attempts)
    counts = {word: sum(line.success is success for line in run.attempts) for success, word in _SUCCESS_WORDS.items()}
    parts = ", ".join(f"{count} {word}" for word, count in counts.items() if count)
    facts = [
        ("run", f"{path} (external, {'complete' if run.is_complete else 'unfinished'})"),
        ("robot", run.robot),
        ("episodes", f"{len(run.attempts)}{f' ({parts})' if parts else ''}"),
        ("frames", f"{frames} ({frames / run.fps:.1f} s at {run.fps} Hz)"),
        ("size", size_in_words(sum(line.num_bytes for line in run.attempts))),
        *(() if roles is None else role_lines.role_facts(roles)),
        ("digest", run.digest),
    ]
    if run.unfinished:
        facts.append(("missing", f"{counted(run.num_missing, 'item')}: {run.unfinished}."))
    rows = [("episode", "outcome", "frames", "size", "file", "task")]
    rows += [
        (
            str(line.episode_index),
            _SUCCESS_WORDS[line.success] + (f": {line.reason}" if line.reason else ""),
            str(line.num_frames),
            size_in_words(line.num_bytes),
            line.file,
            line.instruction,
        )
        for line in run.attempts
    ]
    return [*aligned(facts), "", *aligned(rows)]


def _dataset(path: Path, named: NamedRoles) -> tuple[dict[str, Any], list[str]]:
    from demorec.datasets.lerobot.files import read_json

    file = path / INFO_PATH
    try:
        info: dict[str, Any] = read_json(file)
        facts = [
            ("dataset", f"{path} (LeRobot {info['codebase_version']})"),
            ("episodes", str(info["total_episodes"])),
            ("frames", f"{info['total_frames']} ({info['total_frames'] / info['fps']:.1f} s at {info['fps']} Hz)"),
            ("tasks", str(info["total_tasks"])),
            ("robot", str(info["robot_type"])),
            ("size", size_in_words(sum(part.stat().st_size for part in path.rglob("*") if part.is_file()))),
        ]
        folder, more, problems = _dataset_content(path, named)
        roles = None
        with suppress(ExportError):  # one of the problems
            roles = None if folder is None else folder.roles
        facts += [
            *([] if roles is None else role_lines.role_facts(roles)),
            *more,
            *(("problem", problem) for problem in problems[:_MOST_PROBLEMS]),
        ]
        if len(problems) > _MOST_PROBLEMS:
            facts.append(("problems", f"{len(problems)} in all; demorec check reports more"))
        rows = role_lines.feature_rows(None if roles is None else folder, info)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, ArithmeticError) as error:
        raise RecordingError(f"The dataset's info.json is damaged ({describe_error(error)}): {file}") from error
    plain: dict[str, Any] = {"kind": "dataset", "path": str(path), "info": info, "problems": problems}
    plain["roles"] = None if roles is None else role_lines.roles_as_plain(roles)
    return plain, [*aligned(facts), "", *aligned(rows)]


def _dataset_content(path: Path, named: NamedRoles) -> tuple[LeRobotFolder | None, list[tuple[str, str]], list[str]]:
    """The open dataset, table content beyond info.json, if readable, and the problems of the dataset."""
    from demorec.datasets.lerobot.folder import LeRobotFolder
    from demorec.datasets.lerobot.inspect import attempt_counts, dataset_problems, episode_digests, without_digest
    from demorec.datasets.lerobot.layout import combined_digest

    folder: LeRobotFolder | None = None
    facts: list[tuple[str, str]] = []
    problems: list[str] = []
    try:
        folder = LeRobotFolder(path, named=named)
        problems += dataset_problems(folder)
        for name, item in folder.info.features.items():
            if item.is_video:
                codec = (item.info or {}).get("video.codec", "")
                width, height = item.image_size
                facts.append(("camera", f"{name.removeprefix(IMAGE_PREFIX)} {width}x{height} {codec}"))
        if problems:
            return folder, facts, problems
        if (counts := attempt_counts(folder)) is not None:
            successes, unknown, attempts = counts
            shown = f", {unknown} unknown" if unknown else ""
            facts.insert(0, ("successes", f"{successes}, of {attempts} attempts{shown}"))
        if not without_digest(folder.info):
            facts.append(("digest", combined_digest(folder.info, episode_digests(folder))))
    except ExportError as error:
        if (lack := resource_error(error)) is not None:
            raise lack from error
        problems.append(without_path(error, path))
    return folder, facts, problems


def _folder(found: Found) -> tuple[dict[str, Any], list[str]]:
    from demorec.mcap import open_recording

    path, recordings = found.path, (*found.recordings, *found.failed)
    rows = [("file", "task", "seed", "episode", "outcome", "frames", "size")]
    items = []
    for file in recordings:
        with open_recording(file) as recording:
            info, outcome = recording.info, recording.outcome
            facts = simulation_facts(info)
            task, seed = facts.get("task", "(external)"), str(facts.get("root_seed", ""))
            success = None if outcome is None else outcome.success
        items.append({"path": str(file), "task": task, "success": success, "frames": recording.num_frames})
        word = "recovered" if outcome is None else _SUCCESS_WORDS[outcome.success]
        rows.append(
            (
                str(file.relative_to(path)),
                task,
                seed,
                str(info.episode_index),
                word,
                str(recording.num_frames),
                size_in_words(file.stat().st_size),
            )
        )
    plain = {"kind": "folder", "path": str(path), "recordings": items}
    return plain, [f"{counted(len(recordings), 'recording')} in {path}", "", *aligned(rows)]

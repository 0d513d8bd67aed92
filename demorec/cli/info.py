"""`demorec info`: show the content of a recording, a run, or data of a kind that an extension reads."""

from __future__ import annotations

import pkgutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from demorec.cli.shared.output import aligned, counted, say, say_json, size_in_words
from demorec.cli.shared.paths import (
    MappingFile,
    NamedByFlags,
    Readable,
    RoleFlags,
    need_paths,
    reading,
    tell_unfinished,
)
from demorec.core.errors import ConfigError, RecordingError
from demorec.core.extension import kind_function, kind_rows, reader_rows
from demorec.episode.element_names import is_numbered
from demorec.runs.find import expect, find
from demorec.runs.foreign import dropped_by_import

if TYPE_CHECKING:
    from demorec.episode.roles import NamedRoles, Roles
    from demorec.runs.run_file import GeneratedRun, RunFile

Described = tuple[dict[str, Any], list[str]]
"""Plain data for --json, and lines for the terminal."""
_MOST_ELEMENTS = 4
"""Maximum names of a vector's elements that are listed one by one."""
NO_ROLE = "no role"
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
        tell_unfinished(self.paths)
        named = self.roles.named
        paths = [file for path in self.paths for file in _files_in(path)]
        described = {} if self.mapping is not None or named else _described(paths)
        others = [path for path in paths if path not in described]
        with reading(others, self.mapping) as read:
            described |= {path: _describe(place, named) for path, place in zip(others, read, strict=True)}
            found = [described[path] for path in paths]
            if self.json:
                plain = [item for item, _ in found]
                say_json(plain[0] if len(plain) == 1 else plain)
            else:
                for number, (_, lines) in enumerate(found):
                    say(*([""] if number else []), *lines)
        return 0


def _files_in(path: Path) -> Sequence[Path]:
    """Recordings of a folder that has no description of its own; the path itself for anything else."""
    found = find(path)
    return (*found.recordings, *found.failed) if found.kind in ("recordings", "evaluation") else (path,)


def _described(paths: Sequence[Path]) -> dict[Path, Described]:
    """Describe foreign files that need no import for it."""
    rows = reader_rows()
    found = {path: rows.get(find(path).kind) for path in paths}
    return {path: pkgutil.resolve_name(row.describer)(path) for path, row in found.items() if row and row.describer}


def _describe(path: Path, named: NamedRoles) -> Described:
    kind = expect(path, "recording", "run", *kind_rows()).kind
    describe: Callable[..., Described] = kind_function(kind, "describer") or (_run if kind == "run" else _recording)
    return describe(path, named)


def _recording(path: Path, named: NamedRoles) -> Described:
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
        ("outcome", "unknown: recovered after a crash" if plain["is_recovered"] else _outcome_of(plain)),
        ("length", f"{plain['frames']} frames, {plain['seconds']:.2f} s{rate}"),
        ("robot", plain["robot"] + (" (URDF known)" if plain["has_urdf"] else "")),
    ]
    if plain["task"] is not None:
        facts.append(("objects", ", ".join(plain["objects"]) or "none"))
    if origin := plain["origin"]:
        is_text = isinstance(origin, str)
        facts.append(
            ("origin", origin if is_text else " ".join([origin["kind"], *(f["name"] for f in origin["files"])]))
        )
    facts += _recording_features(plain["features"])
    facts += [(f"camera {camera['name']}", ", ".join(_camera(camera))) for camera in plain["cameras"]]
    facts += [(f"dropped {what}", str(count)) for what, count in plain["drops"].items()]
    for check in plain["checks"]:
        value = f"{check['value']:.4g} {check['unit']}".rstrip()
        verdict = "passed" if check["passed"] else "FAILED"
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


def _outcome_of(plain: Mapping[str, Any]) -> str:
    words = _outcome(plain["success"], plain.get("failure_phase") or "", plain["failure_reason"])
    return words + (f" after {plain['retries']} retries" if plain.get("retries") else "")


def _outcome(success: bool | None, phase: str = "", reason: str = "") -> str:
    return _SUCCESS_WORDS[success] + (f" in phase {phase}" if phase else "") + (f": {reason}" if reason else "")


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


def _recording_features(features: Sequence[Mapping[str, Any]]) -> Iterator[tuple[str, str]]:
    """Known properties of each feature; features without a role come first."""
    roles = {feature["role"] for feature in features}
    yield from ((role, _not_found(role)) for role in ("state", "action") if role not in roles)
    for feature in sorted(features, key=lambda feature: feature["role"] is not None):
        names = elements_in_words(feature["elements"])
        words = [
            feature["role"] or NO_ROLE,
            f"{len(feature['elements'])} {feature['dtype']}{f' ({names})' if names else ''}",
            ", ".join(dict.fromkeys(filter(None, feature["units"]))) or "units unknown",
            f"at most {1000 * feature['oldest']:.3g} ms old",
            feature["source"],
        ]
        yield f"feature {feature['name']}", ", ".join(filter(None, words))


def _not_found(role: str) -> str:
    return f"not found: --{role} FEATURE names it"


def elements_in_words(names: Sequence[str]) -> str:
    """Names of a vector's elements in one line; only the first and the last if there are many."""
    if is_numbered(names):
        return "unnamed" if len(names) > 1 else ""
    return ", ".join(names) if len(names) <= _MOST_ELEMENTS else f"{names[0]} .. {names[-1]}"


def _run(path: Path, named: NamedRoles) -> Described:
    from demorec.episode.roles import SIMULATED_ROLES
    from demorec.runs.run_file import GeneratedRun, load_any_run_file

    run = load_any_run_file(path)
    plain: dict[str, Any] = {"path": str(path), **run.plain(), "complete": run.is_complete, "digest": run.digest}
    left_out: list[dict[str, Any]] = []
    state = "complete" if run.is_complete else "unfinished"
    if not isinstance(run, GeneratedRun):
        state = f"external, {state}"
        roles, left_out = _roles_of_run(path, run, named), dropped_by_import(path)
        plain |= {"kind": "external run", "roles": plain_roles(roles), "left_out": left_out}
        content = _external_facts(run, roles)
    elif named:
        raise ConfigError(SIMULATED_ROLES)
    else:
        plain |= {"kind": "run", "config_digest": run.config_digest}
        content = _generated_facts(path, run)
    frames = sum(attempt.num_frames for attempt in run.attempts)
    fps = run.config.fps if isinstance(run, GeneratedRun) else run.fps
    facts = [
        ("run", f"{path} ({state})"),
        ("frames", f"{frames} ({frames / fps:.1f} s at {fps} Hz)"),
        ("size", size_in_words(sum(attempt.num_bytes for attempt in run.attempts))),
        *content,
        ("digest", run.digest),
    ]
    has_tasks = any(line.instruction for line in run.attempts)
    rows = [("episode", "attempt", "outcome", "frames", "size", "file", "task" if has_tasks else "")]
    for line in run.attempts:
        outcome, size = _outcome(line.success, line.phase, line.reason), size_in_words(line.num_bytes)
        numbers = str(line.episode_index), str(line.attempt), outcome, str(line.num_frames)
        rows.append((*numbers, size, line.file or "(no scene)", line.instruction))
    lines = [*aligned(facts), "", *aligned(rows)]
    if left_out:
        named_parts = ((row["bag"], row["what"], row["reason"]) for row in left_out)
        lines += ["", *aligned([("left out of", "what", "reason"), *named_parts])]
    return plain, lines


def _generated_facts(path: Path, run: GeneratedRun) -> Iterator[tuple[str, str]]:
    config = run.config
    yield "task", f"{config.task} with {config.robot}, seed {config.seed}"
    failed = f", {counted(len(run.failures), 'failed attempt')}" if run.failures else ""
    yield "episodes", f"{len(run.successes)} of {run.num_episodes}{failed}"
    cameras = f"{', '.join(config.cameras)} at {config.width}x{config.height}, {config.video.codec}"
    yield "cameras", cameras if config.cameras else "none"
    if run.export is not None:
        yield "dataset", f"{path / 'dataset'} ({run.export.repo_id})"


def _external_facts(run: RunFile, roles: Roles | None) -> Iterator[tuple[str, str]]:
    yield "robot", run.robot
    counts = {word: sum(line.success is success for line in run.attempts) for success, word in _SUCCESS_WORDS.items()}
    parts = ", ".join(f"{count} {word}" for word, count in counts.items() if count)
    yield "episodes", f"{len(run.attempts)}{f' ({parts})' if parts else ''}"
    yield from role_facts(roles)
    if run.unfinished:
        yield "missing", f"{counted(run.num_missing, 'item')}: {run.unfinished}."


def _roles_of_run(path: Path, run: RunFile, named: NamedRoles) -> Roles | None:
    """Roles of an external run, whose recordings share their features; None if no recording is readable."""
    from demorec.episode.roles import roles_of_recording
    from demorec.mcap import open_recording

    for attempt in run.attempts:
        with suppress(RecordingError), open_recording(path / attempt.file) as recording:
            return roles_of_recording(recording.info, named)
    return None


def plain_roles(roles: Roles | None) -> dict[str, Any] | None:
    """Plain data about the roles; None if they are unknown."""
    if roles is None:
        return None
    state, action = list(roles.state), list(roles.action)
    return {"of": dict(roles.of), "state": state, "action": action, "grippers": _grippers(roles)}


def role_facts(roles: Roles | None) -> Iterator[tuple[str, str]]:
    """(name, value) of the features without a role, state, action and grippers."""
    if roles is None:
        return
    if roles.unknown:
        yield NO_ROLE, ", ".join(roles.unknown)
    for role, parts in (("state", roles.state), ("action", roles.action)):
        count = len(roles.elements(parts))
        yield role, f"{', '.join(parts)} ({count} elements)" if parts else _not_found(role)
    yield "gripper", ", ".join(_grippers(roles)) or "not found: --gripper NAME names it"


def _grippers(roles: Roles) -> list[str]:
    """Names of the state's elements that are grippers."""
    elements = zip(roles.elements(roles.state), roles.grippers().tolist(), strict=True)
    return [name for name, is_gripper in elements if is_gripper]

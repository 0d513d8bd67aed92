"""Content of a report about a LeRobot dataset from any writer."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from demorec.check.report import CheckOptions, Subject, check_subject
from demorec.core.errors import ConfigError, ExportError, describe_error
from demorec.datasets.lerobot.episode_table import EpisodePlace
from demorec.datasets.lerobot.folder import LeRobotFolder
from demorec.datasets.lerobot.inspect import noted
from demorec.datasets.lerobot.layout import DatasetInfo
from demorec.datasets.lerobot.paths import SIDECAR_DIR
from demorec.episode.episode import Outcome, SuccessCheck
from demorec.episode.features import IMAGE_PREFIX
from demorec.episode.roles import NamedRoles, Roles
from demorec.extensions.doctor.diagnosis import Diagnosis
from demorec.extensions.report.content import (
    MAX_COMPONENTS,
    CheckSummaries,
    Components,
    Report,
    ReportedEpisode,
    add_components,
    common_facts,
    judged_episode,
    motion_components,
)
from demorec.extensions.report.filmstrip import MAX_SHOWN, Filmstrip, filmstrip, strip_budget

_SUCCESS = "next.success"
_EPISODE_COLUMNS = (
    "source", "run_episode_index", "attempt", "root_seed", "success", "failure_phase",
    "failure_reason", "num_retries", "checks", "phases", "episode_info",
)  # fmt: skip
_Row = Mapping[str, Any]


def dataset_report(
    root: Path,
    camera: str,
    checks: CheckOptions | None,
    judged: Diagnosis | None,
    named: NamedRoles,
    advance: Callable[[int, int], None],
) -> Report:
    """The content of a page about a dataset; arguments and errors as in `demorec.extensions.report.gather.gather`."""
    folder = LeRobotFolder(root, named=named)
    info, roles = folder.info, folder.roles
    rows = {row["episode_index"]: row for row in folder.sidecar(_EPISODE_COLUMNS)}
    left_out = folder.attempts.failures
    missing = [*folder.notes, *_missing(info, roles, has_sidecar=bool(rows))]
    key = _camera_key(info, camera, root)
    wanted = dict.fromkeys((*roles.state, *roles.action))
    if _SUCCESS in info.features and info.features[_SUCCESS].column.elements:
        wanted[_SUCCESS] = None
    reader = folder.rows(list(wanted)) if wanted else None
    total = len(folder.places) + len(left_out) + (checks is not None)
    stride = max(1, -(-len(folder.places) // MAX_SHOWN))
    components: Components = {}
    episodes: list[ReportedEpisode] = []
    flagged = set() if judged is None else {finding.episode for finding in judged.findings}
    for number, place in enumerate(folder.places):
        columns: Mapping[str, NDArray[Any]] = {}
        strip: Filmstrip | None = None
        problems: list[str] = []
        with noted(problems, root):
            columns = {} if reader is None else reader.numbers(place)
            add_components(components, motion_components(roles, columns))
            if key is not None and (place.episode_index in flagged or number % stride == 0):
                strip = _strip(folder, key, place)
        episode = _episode(place, info.fps, columns, rows.get(place.episode_index))
        episode = replace(episode, filmstrip=strip, problem="; ".join(problems))
        episodes.append(judged_episode(episode, place.episode_index, judged))
        advance(len(episodes), total)
    episodes += [_left_out(row) for row in left_out]
    summaries = CheckSummaries()
    if checks is None:
        missing.append("No checks were run (--no-checks).")
    else:
        summaries.add(check_subject(Subject(path=root, kind="dataset"), checks).results, "the dataset")
        summaries.add_judged(judged)
    advance(total, total)
    return Report(
        title=root.resolve().name,
        kind="LeRobot dataset",
        facts=tuple(_facts(root, info, episodes, len(left_out))),
        episodes=tuple(episodes),
        distributions=components,
        has_units=bool(rows),
        checks=summaries if checks else None,
        missing=tuple(missing),
    )


def _camera_key(info: DatasetInfo, camera: str, root: Path) -> str | None:
    """The feature whose images are shown; None for a dataset without color images.

    Raises:
        ConfigError: The camera does not exist.
    """
    keys = [key for key in _cameras(info) if not info.features[key].is_depth]
    if not camera:
        return keys[0] if keys else None
    for key in keys:
        if camera in (key, key.removeprefix(IMAGE_PREFIX)):
            return key
    there = ", ".join(key.removeprefix(IMAGE_PREFIX) for key in keys) or "none"
    raise ConfigError(f"No camera {camera!r} with color images, available are {there}: {root}")


def _cameras(info: DatasetInfo) -> list[str]:
    return [key for key, feature in info.features.items() if feature.is_camera]


def _strip(folder: LeRobotFolder, key: str, place: EpisodePlace) -> Filmstrip | None:
    """The filmstrip of an episode; ExportError if its images cannot be read."""
    is_video = folder.info.features[key].is_video
    images_at = folder.video(key, place).images_at if is_video else partial(folder.stored_images[key].read, place)
    max_bytes = strip_budget(len(folder.places))
    return filmstrip(key.removeprefix(IMAGE_PREFIX), place.length, images_at, max_bytes=max_bytes)


def _episode(place: EpisodePlace, fps: int, columns: Mapping[str, NDArray[Any]], row: _Row | None) -> ReportedEpisode:
    name = f"episode {place.episode_index}"
    known = ReportedEpisode(name=name, instruction=", ".join(place.tasks), num_frames=place.length, fps=fps)
    if row is None:
        success = bool(columns[_SUCCESS][-1, 0]) if len(columns.get(_SUCCESS, ())) else None
        return replace(known, outcome=_outcome({"success": success}))
    try:
        known = replace(known, source=str(row["source"]), outcome=_outcome(row))
        if row["episode_info"] is None:  # without a scene there is no seed and no phase
            return known
        return replace(
            known,
            seed=row["root_seed"],
            phases=tuple((phase["name"], phase["from"], phase["to"]) for phase in row["phases"]),
        )
    except (ValueError, KeyError, TypeError) as error:
        raise ExportError(f"The sidecar's row of {name} cannot be used ({describe_error(error)})") from error


def _outcome(row: _Row) -> Outcome | None:
    """Outcome of an episode, as far as the sidecar's row records it."""
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


def _missing(info: DatasetInfo, roles: Roles, *, has_sidecar: bool) -> Iterator[str]:
    """Sentences about data missing from the dataset."""
    if not has_sidecar:
        yield (
            f"The dataset has no folder {SIDECAR_DIR}/, which exports of demorec have: random seeds, phases "
            "and the conditions of success are not known."
        )
        if _SUCCESS not in info.features:
            yield f"Without a column {_SUCCESS}, the outcomes of the episodes are not known."
    if all(info.features[key].is_depth for key in _cameras(info)):
        yield "It has no color images, so there are no filmstrips."
    yield from roles.notes()
    for role, parts in (("state", roles.state), ("action", roles.action)):
        if (count := len(roles.elements(parts))) > MAX_COMPONENTS:
            yield f"Only the first {MAX_COMPONENTS} of the {count} components of the {role} are drawn."


def _facts(
    root: Path, info: DatasetInfo, episodes: list[ReportedEpisode], num_left_out: int
) -> Iterator[tuple[str, str]]:
    yield "episodes", str(len(episodes) - num_left_out)
    if num_left_out:
        yield "attempts", f"{len(episodes)}, of which {num_left_out} are not in the dataset"
    yield from common_facts(episodes, (file for file in root.rglob("*") if file.is_file()))
    yield "robot", info.robot_type or "unknown"
    cameras = (
        f"{key.removeprefix(IMAGE_PREFIX)} {'x'.join(str(n) for n in info.features[key].shape[1::-1])}"
        for key in _cameras(info)
    )
    yield "cameras", ", ".join(cameras) or "none"
    yield "tasks", str(info.total_tasks)
    yield "format", f"LeRobot {info.version}"

"""Output of `demorec info` about datasets."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from demorec.cli.info import NO_ROLE, Described, elements_in_words, plain_roles, role_facts
from demorec.cli.shared.output import aligned, size_in_words
from demorec.core.errors import ExportError, RecordingError, describe_error, resource_error, without_path
from demorec.datasets.lerobot.files import read_json
from demorec.datasets.lerobot.layout import combined_digest
from demorec.datasets.lerobot.paths import INFO_PATH
from demorec.episode.features import IMAGE_PREFIX
from demorec.episode.roles import ROLES, NamedRoles, Roles
from demorec.extensions.datasets.folder import LeRobotFolder
from demorec.extensions.datasets.inspect import dataset_problems, episode_digests, without_digest

_MOST_PROBLEMS = 5
"""Maximum problems that are listed one by one."""


def describe_dataset(path: Path, named: NamedRoles) -> Described:
    """Describe a dataset by info.json, the roles of its features, and its content as far as it can be read."""
    file = path / INFO_PATH
    roles = None
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
        with suppress(ExportError):  # one of the problems
            roles = None if folder is None else folder.roles
        facts += [*role_facts(roles), *more, *(("problem", problem) for problem in problems[:_MOST_PROBLEMS])]
        if len(problems) > _MOST_PROBLEMS:
            facts.append(("problems", f"{len(problems)} in all; demorec check reports more"))
        rows = _feature_rows(roles, info)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, ArithmeticError) as error:
        raise RecordingError(f"The dataset's info.json is damaged ({describe_error(error)}): {file}") from error
    plain = {"kind": "dataset", "path": str(path), "info": info, "problems": problems, "roles": plain_roles(roles)}
    return plain, [*aligned(facts), "", *aligned(rows)]


def _dataset_content(path: Path, named: NamedRoles) -> tuple[LeRobotFolder | None, list[tuple[str, str]], list[str]]:
    """The open dataset, table content beyond info.json, if readable, and the problems of the dataset."""
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
        outcomes = [row["success"] for row in folder.sidecar(["success"])]
        if any(outcome is not None for outcome in outcomes):
            unknown = f", {outcomes.count(None)} unknown" if None in outcomes else ""
            facts.insert(0, ("successes", f"{outcomes.count(True)} of {len(outcomes)}{unknown}"))
        if not without_digest(folder.info):
            facts.append(("digest", combined_digest(folder.info, episode_digests(folder))))
    except ExportError as error:
        if (lack := resource_error(error)) is not None:
            raise lack from error
        problems.append(without_path(error, path))
    return folder, facts, problems


def _feature_rows(roles: Roles | None, info: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """A row for each feature of a dataset, after a header: features without a role first, counters last.

    Args:
        roles: Role of each feature; None if info.json cannot be interpreted.
        info: Content of info.json, unchecked.
    """
    types = {name: (str(item["dtype"]), "x".join(map(str, item["shape"]))) for name, item in info["features"].items()}
    if roles is None:
        return [("feature", "dtype", "shape"), *((name, *kind) for name, kind in types.items())]
    order = [None, *(role for role in ROLES if role is not None)]
    rows = [("role", "feature", "dtype", "shape", "elements")]
    for name in sorted(roles.of, key=lambda name: order.index(roles.of[name])):
        column, role = roles.columns[name], roles.of[name]
        rows.append((role or NO_ROLE, name, *types[name], elements_in_words(column.elements)))
    return rows + [("", name, *kind, "") for name, kind in types.items() if name not in roles.of]

"""Lines about the roles of features: the role of each, and its known properties."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from demorec.core.errors import ExportError, RecordingError
from demorec.episode.element_names import is_numbered

if TYPE_CHECKING:
    from demorec.datasets.lerobot.folder import LeRobotFolder
    from demorec.episode.roles import NamedRoles, Role, Roles
    from demorec.runs.run_file import RunFile

_NO_ROLE = "no role"
_MAX_NAMES = 4


def roles_as_plain(roles: Roles) -> dict[str, Any]:
    """The roles as data for JSON."""
    return {
        "of": dict(roles.of),
        "state": list(roles.state),
        "action": list(roles.action),
        "grippers": _grippers(roles),
    }


def role_facts(roles: Roles) -> Iterator[tuple[str, str]]:
    """(name, value) of the features without a role, state, action and grippers."""
    if roles.unknown:
        yield _NO_ROLE, ", ".join(roles.unknown)
    for role, parts in (("state", roles.state), ("action", roles.action)):
        count = len(roles.elements(parts))
        yield role, f"{', '.join(parts)} ({count} elements)" if parts else _not_found(role)
    yield "gripper", ", ".join(_grippers(roles)) or "not found: --gripper NAME names it"


def _not_found(role: str) -> str:
    """Text for a missing state or action."""
    return f"not found: --{role} FEATURE names it"


def _grippers(roles: Roles) -> list[str]:
    """Names of the state's elements that are grippers."""
    elements = zip(roles.elements(roles.state), roles.grippers().tolist(), strict=True)
    return [name for name, is_gripper in elements if is_gripper]


def roles_of_run(path: Path, run: RunFile, named: NamedRoles) -> Roles | None:
    """Roles of an external run, whose recordings share their features; None if no recording is readable."""
    from demorec.episode.roles import roles_of_recording
    from demorec.mcap import open_recording

    for attempt in run.attempts:
        try:
            with open_recording(path / attempt.file) as recording:
                return roles_of_recording(recording.info, named)
        except RecordingError:
            continue
    return None


def feature_rows(folder: LeRobotFolder | None, info: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """A row for each feature of a dataset, after a header: features without a role first, counters last.

    Args:
        folder: The open dataset; None if info.json cannot be interpreted.
        info: Content of info.json, unchecked.
    """
    types = {name: (str(item["dtype"]), "x".join(map(str, item["shape"]))) for name, item in info["features"].items()}
    if folder is None:
        return [("feature", "dtype", "shape"), *((name, *kind) for name, kind in types.items())]
    from demorec.datasets.lerobot.inspect import known_units
    from demorec.episode.roles import ROLES

    units: Mapping[str, tuple[str, ...]] = {}
    with suppress(ExportError):  # demorec check reports it
        units = known_units(folder)
    roles = folder.roles
    order: list[Role | None] = [None, *(role for role in ROLES if role is not None)]
    rows = [("role", "feature", "dtype", "shape", "elements", "units")]
    for name in sorted(roles.of, key=lambda name: order.index(roles.of[name])):
        column, role = roles.columns[name], roles.of[name]
        unit = ", ".join(dict.fromkeys(filter(None, units.get(name, ())))) or (
            "unknown" if column.is_vector and role != "label" else ""
        )
        rows.append((role or _NO_ROLE, name, *types[name], _elements_in_words(column.elements), unit))
    return rows + [("", name, *kind, "", "") for name, kind in types.items() if name not in roles.of]


def recording_features(features: Sequence[Mapping[str, Any]]) -> list[tuple[str, str]]:
    """Known properties of each feature; features without a role come first."""
    roles = {feature["role"] for feature in features}
    facts = [(role, _not_found(role)) for role in ("state", "action") if role not in roles]
    for feature in sorted(features, key=lambda feature: feature["role"] is not None):
        facts.append((f"feature {feature['name']}", ", ".join(_feature(feature))))
    return facts


def _feature(feature: Mapping[str, Any]) -> Iterator[str]:
    names = _elements_in_words(feature["elements"])
    yield feature["role"] or "no role"
    yield f"{len(feature['elements'])} {feature['dtype']}{f' ({names})' if names else ''}"
    yield ", ".join(dict.fromkeys(filter(None, feature["units"]))) or "units unknown"
    yield f"at most {1000 * feature['oldest']:.3g} ms old"
    if feature["source"]:
        yield feature["source"]


def _elements_in_words(names: Sequence[str]) -> str:
    """Names of a vector's elements in one line; only the first and the last if there are many."""
    if is_numbered(names):
        return "unnamed" if len(names) > 1 else ""
    return ", ".join(names) if len(names) <= _MAX_NAMES else f"{names[0]} .. {names[-1]}"

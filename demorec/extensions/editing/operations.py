"""Operations that make a plan from a dataset; none writes anything."""

from __future__ import annotations

import ast
import operator
import pkgutil
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from demorec.core.errors import ConfigError, OptionError, check_option, check_seed
from demorec.core.extension import rows_of
from demorec.core.registry import check_choice, nearest_match
from demorec.core.replacing import shown
from demorec.datasets.lerobot.folder import LeRobotFolder
from demorec.datasets.lerobot.inspect import episode_columns
from demorec.datasets.lerobot.layout import AUTOMATIC_FEATURES
from demorec.extensions.editing.cut import WatchedNumbers
from demorec.extensions.editing.plan import FeatureMapping, Plan

_SHARE_TOLERANCE = 1e-6
_MAX = 2000
_MOST_LISTED = 30
_CONSTANTS = {"true": True, "false": False, "none": None, "null": None}
_COMPARED: dict[type[ast.cmpop], Callable[[Any, Any], Any]] = {
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.In: lambda a, b: a in b,
    ast.NotIn: lambda a, b: a not in b,
}
_EQUALITIES = (ast.Eq, ast.NotEq)
_Value = Callable[[Mapping[str, Any]], Any]
"""Value of a part of a condition, from an episode's columns."""

Rows = Sequence[Mapping[str, Any]]
"""Values of each episode in order, from `columns_of`."""


def columns_of(folder: LeRobotFolder, names: Collection[str]) -> list[dict[str, Any]]:
    """Read the columns of each episode, including requested columns of extensions that the dataset lacks."""
    columns = episode_columns(folder)
    wanted: dict[str, list[str]] = {}
    for name, target in rows_of("columns"):
        if name in names and not any(name in row for row in columns):
            wanted.setdefault(target, []).append(name)
    for target, added in wanted.items():
        values = pkgutil.resolve_name(target)(folder, added)
        columns = [row | more for row, more in zip(columns, values, strict=True)]
    return columns


def chosen(rows: Rows, where: str, episodes: Sequence[int]) -> list[int]:
    """Numbers of the listed episodes that fulfil a condition, each once; ConfigError for an impossible one."""
    found = list(dict.fromkeys(episodes))
    if where:
        condition = Condition(where, _names(rows))
        found = [number for number in found if condition.holds(rows[number])]
    return found


def _names(rows: Rows) -> list[str]:
    return list(dict.fromkeys(name for row in rows for name in row))


def _no_column(name: str, names: Sequence[str]) -> ConfigError:
    return ConfigError(f"Unknown column {name!r}.{nearest_match(name, names)} Allowed: {shown(names, _MOST_LISTED)}.")


def select(source: LeRobotFolder, numbers: Sequence[int], *, drop: bool = False) -> Plan:
    """These episodes, in the dataset's order, or all others."""
    plan = Plan.whole(source)
    wanted = set(numbers)
    return plan.with_cuts([cut for cut in plan.cuts if (cut.episode in wanted) != drop])


def reorder(
    source: LeRobotFolder, rows: Rows = (), by: str = "", order: Sequence[int] = (), *, descending: bool = False
) -> Plan:
    """All episodes, sorted by a column with missing values last, or in a given order."""
    plan = Plan.whole(source)
    if bool(by) == bool(order):
        raise ConfigError("Give either --by or --order.")
    if order:
        if sorted(order) != list(range(len(plan.cuts))):
            raise ConfigError(f"--order names each of the {len(plan.cuts)} episodes once, from 0 on.")
        return plan.with_cuts([plan.cuts[number] for number in order])
    if by not in (names := _names(rows)):
        raise _no_column(by, names)
    known = [number for number, row in enumerate(rows) if row.get(by) is not None]
    try:
        known.sort(key=lambda number: rows[number][by], reverse=descending)
    except TypeError as error:
        raise ConfigError(f"The values of {by} cannot be sorted.") from error
    rest = [number for number in range(len(rows)) if rows[number].get(by) is None]
    return plan.with_cuts([plan.cuts[number] for number in (*known, *rest)])


def shuffle(source: LeRobotFolder, seed: int) -> Plan:
    """All episodes in a random order by seed."""
    check_seed("seed", seed)
    plan = Plan.whole(source)
    order = np.random.default_rng(seed).permutation(len(plan.cuts)).tolist()
    return plan.with_cuts([plan.cuts[number] for number in order])


def trim(source: LeRobotFolder, head: int, tail: int) -> Plan:
    """Every episode without its first and last frames."""
    if min(head, tail) < 0:
        raise ConfigError("The number of frames to cut off must be at least 0.")
    plan = Plan.whole(source)
    if short := [str(cut.episode) for cut in plan.cuts if cut.last <= head + tail]:
        listed = ",".join(short[:_MOST_LISTED]) + (",..." if len(short) > _MOST_LISTED else "")
        raise ConfigError(f"These episodes would be empty, drop them first: {listed}")
    return plan.with_cuts([replace(cut, first=head, last=cut.last - tail) for cut in plan.cuts])


def trim_idle(source: LeRobotFolder, features: Sequence[str], threshold: float, margin: int) -> Plan:
    """Every episode without the still frames at its beginning and end.

    Args:
        source: The dataset.
        features: Features to watch.
        threshold: Maximum change of each number in still frames, as a ratio of its range over the dataset.
        margin: Still frames to keep at either end.
    """
    watched = WatchedNumbers(source, features)
    if not 0 < threshold <= 1:
        raise OptionError("idle_threshold", f"is {threshold}, allowed are ratios above 0 and up to 1.")
    check_option("idle_margin", margin, 0, 2**63 - 1, "frames")
    plan = Plan.whole(source)
    least = threshold * watched.ranges()
    cuts = []
    for cut in plan.cuts:
        values = watched.episode(cut.episode)
        # Compared with the initial and final values, so that slow motion counts as well.
        away_from_start = np.flatnonzero((np.abs(values - values[0]) > least).any(axis=1))
        away_from_end = np.flatnonzero((np.abs(values - values[-1]) > least).any(axis=1))
        if not len(away_from_start):
            cuts.append(cut)  # no motion at all: that is a decision for `drop`
            continue
        first = max(0, int(away_from_start[0]) - 1 - margin)
        last = min(cut.last, int(away_from_end[-1]) + 2 + margin)
        cuts.append(replace(cut, first=first, last=max(last, first + 1)))
    return plan.with_cuts(cuts)


def split(
    source: LeRobotFolder, rows: Rows, shares: Mapping[str, float], seed: int, *, by: str = ""
) -> dict[str, Plan]:
    """Name -> part of the dataset; each value of the column `by` is divided in the same proportions, and no part is
    empty.

    Episodes stay in the dataset's order. Raises ConfigError for impossible shares.
    """
    check_seed("seed", seed)
    total = sum(shares.values())
    if len(shares) < 2 or not all(share > 0 for share in shares.values()) or abs(total - 1) > _SHARE_TOLERANCE:
        raise ConfigError(
            f"Shares are two or more numbers above 0 whose sum is 1, not {total:g}, such as train=0.8 val=0.2."
        )
    plan = Plan.whole(source)
    if by and by not in (names := _names(rows)):
        raise _no_column(by, names)
    groups: dict[str, list[int]] = {}
    for number, row in enumerate(rows):
        groups.setdefault(str(row.get(by)) if by else "", []).append(number)
    ends = np.cumsum(list(shares.values()))
    found: dict[str, set[int]] = {name: set() for name in shares}
    rng = np.random.default_rng(seed)
    for group in groups.values():
        order = rng.permutation(group)
        begins = [0, *np.rint(ends * len(order)).astype(int).tolist()]
        for name, begin, end in zip(shares, begins, begins[1:], strict=False):
            found[name] |= set(order[begin:end].tolist())
    if empty := [name for name, numbers in found.items() if not numbers]:
        raise ConfigError(f"The part {empty[0]} would be empty: the dataset has {len(rows)}.")
    return {name: plan.with_cuts([plan.cuts[number] for number in sorted(numbers)]) for name, numbers in found.items()}


def set_task(source: LeRobotFolder, task: str, numbers: Sequence[int]) -> Plan:
    """All episodes, some with another instruction."""
    if not task.strip() or not task.isprintable():
        raise ConfigError("An instruction is a line of text, such as --task 'pick up the cup'.")
    if not numbers:
        raise ConfigError("No episode is selected for the new instruction.")
    plan = Plan.whole(source)
    wanted = set(numbers)
    return plan.with_cuts([replace(cut, task=task) if cut.episode in wanted else cut for cut in plan.cuts])


def rename(source: LeRobotFolder, names: Mapping[str, str]) -> Plan:
    """All episodes with renamed features; ConfigError for names that are unknown, fixed or taken."""
    plan = Plan.whole(source)
    _check_features(source, names)
    kept = [names.get(name, name) for name in plan.info.features]
    for name in names.values():
        if not name.isprintable() or "/" in name or not name or name.startswith(".") or ".." in name:
            raise ConfigError(f"A feature cannot be called {name!r}: letters, digits, dots and underscores, no slash.")
    if twice := [name for name in kept if kept.count(name) > 1]:
        raise ConfigError(f"Two features would be called {twice[0]!r}.")
    features = {names.get(name, name): feature for name, feature in plan.info.features.items()}
    mappings = {names.get(name, name): mapping for name, mapping in plan.mappings[0].items()}
    return plan.with_features(features, mappings)


def drop_features(source: LeRobotFolder, names: Sequence[str]) -> Plan:
    """All episodes without some features."""
    plan = Plan.whole(source)
    if not names:
        raise ConfigError("Name the features to leave out: demorec dataset drop-features DATASET NAME... --out NEW.")
    _check_features(source, names)
    features = {name: feature for name, feature in plan.info.features.items() if name not in names}
    if set(features) <= set(AUTOMATIC_FEATURES):
        raise ConfigError("No feature would be left.")
    mappings = {name: mapping for name, mapping in plan.mappings[0].items() if name in features}
    return plan.with_features(features, mappings)


def _check_features(source: LeRobotFolder, names: Mapping[str, str] | Sequence[str]) -> None:
    for name in names:
        check_choice("feature that can be changed", name, _own(source))


def _own(source: LeRobotFolder) -> list[str]:
    """Names of its features except the automatic ones."""
    return [name for name in source.info.features if name not in AUTOMATIC_FEATURES]


def joined(plans: Sequence[Plan]) -> Plan:
    """Concatenate plans of one source each with the same features."""
    sources = tuple(source for plan in plans for source in plan.sources)
    cuts = [replace(cut, source=number) for number, plan in enumerate(plans) for cut in plan.cuts]
    mappings: tuple[Mapping[str, FeatureMapping], ...] = tuple(mapping for plan in plans for mapping in plan.mappings)
    other = {
        name: value
        for name, value in plans[0].info.other.items()
        if all(plan.info.other.get(name) == value for plan in plans)
    }
    return Plan(sources=sources, cuts=tuple(cuts), info=replace(plans[0].info, other=other), mappings=mappings)


class Condition:
    """A parsed condition of `--where`: comparisons of columns with values, joined by and, or, not.

        success and num_frames < 300
        "cube" in task and num_retries >= 1
        episode_index in (3, 7)

    Nothing is evaluated as Python: the parsed text is translated, and everything beyond this grammar is refused.

    Raises:
        ConfigError: Not a condition, or an unknown column.
    """

    def __init__(self, text: str, columns: Sequence[str]) -> None:
        self._text, self._columns = text, columns
        try:
            if len(text) > _MAX:
                raise SyntaxError
            tree = ast.parse(text.strip(), mode="eval").body
        except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
            raise ConfigError(
                "This is not a condition: compare by == != < <= > >= in, join by and, or, not, and put text in quotes, "
                f'such as num_frames < 300 and "cube" in task: {text}'
            ) from error
        self._holds = self._truth(tree)

    def holds(self, row: Mapping[str, Any]) -> bool:
        """Whether it is true for an episode; a comparison with an unknown value is false."""
        return bool(self._holds(row))

    def _value(self, node: ast.expr) -> _Value:
        match node:
            case ast.Constant(value=bool() | int() | float() | str() | None as value):
                return lambda row: value
            case ast.Tuple(elts=parts) | ast.List(elts=parts):
                values = [self._value(part) for part in parts]
                return lambda row: [value(row) for value in values]
            case ast.UnaryOp(op=ast.USub(), operand=ast.Constant(value=int() | float() as value)):
                return lambda row: -value
            case ast.UnaryOp(op=ast.Not(), operand=part):
                truth = self._truth(part)
                return lambda row: not truth(row)
            case ast.BoolOp(op=joined, values=parts):
                truths = [self._truth(part) for part in parts]
                combine = all if isinstance(joined, ast.And) else any
                return lambda row: combine(truth(row) for truth in truths)
            case ast.Compare(left=left, ops=kinds, comparators=rights):
                return self._comparison(kinds, [self._value(part) for part in (left, *rights)])
            case _:
                return self._column(node)

    def _truth(self, node: ast.expr) -> _Value:
        """Value of an operand of and, or, not; a value alone, such as "b" in `task == "a" or "b"`, would always be
        true.
        """
        if isinstance(node, ast.Tuple | ast.List) or (
            isinstance(node, ast.Constant) and not isinstance(node.value, bool)
        ):
            raise ConfigError(f"A condition joins comparisons, and {ast.unparse(node)} alone is not one: {self._text}")
        return self._value(node)

    def _comparison(self, kinds: Sequence[ast.cmpop], values: Sequence[_Value]) -> _Value:
        if not all(type(kind) in _COMPARED for kind in kinds):
            raise ConfigError(f"Values are compared by ==, !=, <, <=, >, >=, in and not in: {self._text}")
        return lambda row: all(
            self._compare(kind, left(row), right(row))
            for kind, left, right in zip(kinds, values, values[1:], strict=False)
        )

    def _compare(self, kind: ast.cmpop, left: Any, right: Any) -> bool:
        if (left is None or right is None) and not isinstance(kind, _EQUALITIES):
            return False
        try:
            return bool(_COMPARED[type(kind)](left, right))
        except TypeError as error:
            raise ConfigError(f"{left!r} and {right!r} cannot be compared so: {self._text}") from error

    def _column(self, node: ast.expr) -> _Value:
        name = _name(node)
        if name is None:
            raise ConfigError(
                "A condition has columns, values, comparisons, and, or, not and parentheses, and nothing else: "
                f"{self._text}"
            )
        if name in self._columns:
            return lambda row: row.get(name)
        if name in _CONSTANTS:
            return lambda row: _CONSTANTS[name]
        raise _no_column(name, self._columns)


def names_in(text: str) -> set[str]:
    """Words of a condition that may be columns; empty for an invalid condition."""
    try:
        return {node.id for node in ast.walk(ast.parse(text.strip(), mode="eval")) if isinstance(node, ast.Name)}
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return set()


def _name(node: ast.expr) -> str | None:
    """Name of a column, which may contain slashes and dots."""
    match node:
        case ast.Name(id=name):
            return name
        case ast.Attribute(value=value, attr=last):
            first = _name(value)
            return None if first is None else f"{first}.{last}"
        case ast.BinOp(op=ast.Div(), left=left, right=right):
            a, b = _name(left), _name(right)
            return None if a is None or b is None else f"{a}/{b}"
    return None

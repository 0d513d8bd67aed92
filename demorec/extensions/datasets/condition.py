"""Columns of episodes, and the conditions of `--where` on them."""

from __future__ import annotations

import ast
import operator
import pkgutil
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

from demorec.core.errors import ConfigError
from demorec.core.extension import rows_of
from demorec.core.registry import nearest_match
from demorec.core.replacing import shown
from demorec.extensions.datasets.folder import LeRobotFolder
from demorec.extensions.datasets.inspect import episode_columns

_MAX_LENGTH = 2000
_MAX_LISTED = 30
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

Row = Mapping[str, Any]
"""Column -> value of an episode."""


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


def check_column(name: str, rows: Sequence[Row]) -> None:
    """Raise ConfigError if no episode has the column."""
    if not any(name in row for row in rows):
        names = list(dict.fromkeys(name for row in rows for name in row))
        raise ConfigError(f"Unknown column {name!r}.{nearest_match(name, names)} Allowed: {shown(names, _MAX_LISTED)}.")


def matching_episodes(folder: LeRobotFolder, where: str) -> set[int]:
    """Numbers of the episodes that fulfil a condition; all for "".

        success and num_frames < 300
        "cube" in task and num_retries >= 1
        episode_index in (3, 7)

    Nothing is evaluated as Python: everything beyond comparisons of columns with values, joined by and, or, not, is
    refused. A comparison with an unknown value is false.

    Raises:
        ConfigError: Not a condition, or an unknown column.
    """
    if not where:
        return set(range(len(folder.places)))
    try:
        if len(where) > _MAX_LENGTH:
            raise SyntaxError
        tree = ast.parse(where.strip(), mode="eval").body
        rows = columns_of(folder, {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)})
        return {number for number, row in enumerate(rows) if _Condition(where, rows).is_true(tree, row)}
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise ConfigError(
            "This is not a condition: compare by == != < <= > >= in, join by and, or, not, and put text in quotes, "
            f'such as num_frames < 300 and "cube" in task: {where}'
        ) from error


class _Condition:
    """Evaluation of a parsed condition; no operand is skipped, so that each column is checked."""

    def __init__(self, text: str, rows: Sequence[Row]) -> None:
        self._text, self._rows = text, rows

    def is_true(self, node: ast.expr, row: Row) -> bool:
        """Evaluate an operand of and, or, not.

        A value alone, such as "b" in `task == "a" or "b"`, would always be true.
        """
        is_boolean = isinstance(node, ast.Constant) and isinstance(node.value, bool)
        if isinstance(node, ast.Tuple | ast.List | ast.Constant) and not is_boolean:
            raise ConfigError(f"A condition joins comparisons, and {ast.unparse(node)} alone is not one: {self._text}")
        return bool(self._value(node, row))

    def _value(self, node: ast.expr, row: Row) -> Any:
        match node:
            case ast.Constant(value=bool() | int() | float() | str() | None as value):
                return value
            case ast.Tuple(elts=parts) | ast.List(elts=parts):
                return [self._value(part, row) for part in parts]
            case ast.UnaryOp(op=ast.USub(), operand=ast.Constant(value=int() | float() as value)):
                return -value
            case ast.UnaryOp(op=ast.Not(), operand=part):
                return not self.is_true(part, row)
            case ast.BoolOp(op=joined, values=parts):
                truths = [self.is_true(part, row) for part in parts]
                return all(truths) if isinstance(joined, ast.And) else any(truths)
            case ast.Compare(left=left, ops=kinds, comparators=rights):
                values = [self._value(part, row) for part in (left, *rights)]
                return all(self._compare(*each) for each in zip(kinds, values, values[1:], strict=False))
            case ast.Name(id=name):
                if name in _CONSTANTS and name not in row:
                    return _CONSTANTS[name]
                check_column(name, self._rows)
                return row.get(name)
        raise ConfigError(
            "A condition has columns, values, comparisons, and, or, not and parentheses, and nothing else: "
            f"{self._text}"
        )

    def _compare(self, kind: ast.cmpop, left: Any, right: Any) -> bool:
        if type(kind) not in _COMPARED:
            raise ConfigError(f"Values are compared by ==, !=, <, <=, >, >=, in and not in: {self._text}")
        if (left is None or right is None) and not isinstance(kind, ast.Eq | ast.NotEq):
            return False
        try:
            return bool(_COMPARED[type(kind)](left, right))
        except TypeError as error:
            raise ConfigError(f"{left!r} and {right!r} cannot be compared so: {self._text}") from error

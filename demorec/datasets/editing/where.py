"""The little language of `--where`: comparisons of columns with values, joined by and, or, not. Nothing is evaluated as
Python: what it parses is looked through, and anything else than this grammar is refused.

    success and num_frames < 300
    "cube" in task and drawn/speed >= 0.9
    episode_index in (3, 7)
"""

from __future__ import annotations

import ast
import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from demorec.core.errors import ConfigError
from demorec.core.registry import nearest_match

_MAX = 2000
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


class Condition:
    """A parsed condition; `holds` says whether it is true of an episode. ConfigError for what is none."""

    def __init__(self, text: str, columns: Sequence[str]) -> None:
        self._text, self._columns = text, columns
        try:
            if len(text) > _MAX:
                raise SyntaxError
            self._tree = ast.parse(text.strip(), mode="eval").body
        except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
            raise ConfigError(f"This is no condition, write for example success and length < 300: {text}") from error
        self._value(self._tree, dict.fromkeys(columns), checks=True)

    def holds(self, row: Mapping[str, Any]) -> bool:
        """Whether it is true of these values; a comparison with a value that is not known is false."""
        return bool(self._value(self._tree, row, checks=False))

    def _value(self, node: ast.expr, row: Mapping[str, Any], *, checks: bool) -> Any:
        match node:
            case ast.Constant(value=bool() | int() | float() | str() | None as value):
                return value
            case ast.Tuple(elts=parts) | ast.List(elts=parts):
                return [self._value(part, row, checks=checks) for part in parts]
            case ast.UnaryOp(op=ast.USub(), operand=ast.Constant(value=int() | float() as value)):
                return -value
            case ast.UnaryOp(op=ast.Not(), operand=part):
                return not self._value(part, row, checks=checks)
            case ast.BoolOp(op=joined, values=parts):
                values = [self._value(part, row, checks=checks) for part in parts]
                return all(values) if isinstance(joined, ast.And) else any(values)
            case ast.Compare(left=left, ops=kinds, comparators=rights):
                values = [self._value(part, row, checks=checks) for part in (left, *rights)]
                pairs = zip(kinds, values, values[1:], strict=False)
                return True if checks and self._known(kinds) else all(self._compare(*pair) for pair in pairs)
            case _:
                return self._column(node, row)

    def _known(self, kinds: Sequence[ast.cmpop]) -> bool:
        if not all(type(kind) in _COMPARED for kind in kinds):
            raise ConfigError(f"Values are compared by ==, !=, <, <=, >, >=, in and not in: {self._text}")
        return True

    def _compare(self, kind: ast.cmpop, left: Any, right: Any) -> bool:
        if (left is None or right is None) and not isinstance(kind, _EQUALITIES):
            return False
        try:
            return bool(_COMPARED[type(kind)](left, right))
        except TypeError as error:
            raise ConfigError(f"{left!r} and {right!r} cannot be compared so: {self._text}") from error

    def _column(self, node: ast.expr, row: Mapping[str, Any]) -> Any:
        name = _name(node)
        if name is None:
            raise ConfigError(
                "A condition has columns, values, comparisons, and, or, not and parentheses, and nothing else: "
                f"{self._text}"
            )
        if name in row:
            return row[name]
        if name in _CONSTANTS:
            return _CONSTANTS[name]
        if name in self._columns:
            return None
        raise ConfigError(f"There is no column {name!r}.{nearest_match(name, self._columns)} Condition: {self._text}")


def names_in(text: str) -> set[str]:
    """Words of a condition that may be columns; none of what is no condition."""
    try:
        return {node.id for node in ast.walk(ast.parse(text.strip(), mode="eval")) if isinstance(node, ast.Name)}
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return set()


def _name(node: ast.expr) -> str | None:
    """A column's name, which may have slashes and dots in it."""
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

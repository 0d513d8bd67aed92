"""The options of every command, found by their types, so that those of a new command are tried as well."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any, Literal, NamedTuple, get_args, get_origin, get_type_hints

from tyro.conf import Positional

from demorec.cli import COMMANDS, subcommands_of
from demorec.core.replacing import OptionalTarget, Target
from demorec.core.tables import EXPORTERS

_POSITIONAL = get_args(Positional[int])[1]


class Option(NamedTuple):
    """An option of a command: the words of the command, its name, and its type."""

    command: tuple[str, ...]
    name: str
    type: Any
    is_required: bool

    @property
    def is_positional(self) -> bool:
        return _POSITIONAL in get_args(self.type)

    def takes(self, *kinds: object) -> bool:
        """Whether its values, or those of a pair or list, have one of these types."""
        return any(kind in kinds for kind in parts_of(self.type))

    @property
    def is_pair(self) -> bool:
        return any(get_origin(kind) is tuple and Ellipsis not in get_args(kind) for kind in parts_of(self.type))


def parts_of(kind: Any) -> Iterator[Any]:
    yield kind
    if get_origin(kind) is not Literal:
        for part in get_args(kind):
            yield from parts_of(part)


def _fields(owner: type) -> Iterator[tuple[str, Any, bool]]:
    hints = get_type_hints(owner, include_extras=True)
    for field in dataclasses.fields(owner):
        kinds = [
            kind for kind in parts_of(hints[field.name]) if isinstance(kind, type) and dataclasses.is_dataclass(kind)
        ]
        if kinds:
            yield from _fields(kinds[0])
        else:
            is_required = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
            yield field.name, hints[field.name], is_required


def _options() -> Iterator[Option]:
    for name in COMMANDS.names():
        command = COMMANDS.load(name)
        below = subcommands_of(command)
        found = [((name,), command)] if below is None else [((name, sub), below.load(sub)) for sub in below.names()]
        for words, owner in found:
            yield from (Option(words, *field) for field in _fields(owner))
    for name in EXPORTERS.names():
        yield from (Option(("export", name), *field) for field in _fields(EXPORTERS.load(name).options))


OPTIONS = tuple(_options())
TARGETS = [option for option in OPTIONS if {Target, OptionalTarget} & {option.type}]
"""Options that name a new file or folder."""

"""Tables of things that a user names: tasks, robots, cameras, renderers, exporters, checks.

A row maps a name to "module:attribute", imported when it is used: listing what there is costs nothing, and a
heavy library is loaded only by the row that needs it.
"""

from __future__ import annotations

import difflib
import importlib
import inspect
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from itertools import islice
from typing import Any, cast

from demorec.core.errors import ConfigError, NotAllowedError
from demorec.core.user_modules import import_object, is_allowed, split_name

_LONGEST = 100
"""Characters of names that are compared with others, which takes the product of both and of how many there are."""


def nearest_match(name: str, allowed: Iterable[str]) -> str:
    """Return " Did you mean 'x'?" for the closest allowed name, or an empty string."""
    few = [other for other in islice(allowed, 5 * _LONGEST) if len(other) <= _LONGEST]
    matches = difflib.get_close_matches(name, few, n=1, cutoff=0.5) if len(name) <= _LONGEST else []
    return f" Did you mean {matches[0]!r}?" if matches else ""


def check_choice[T: str](kind: str, name: str, allowed: Collection[T]) -> T:
    """Return `name`; ConfigError with the nearest match unless it is allowed."""
    for choice in allowed:
        if choice == name:
            return choice
    raise ConfigError(f"Unknown {kind} {name!r}.{nearest_match(name, allowed)} Allowed: {', '.join(allowed)}.")


@dataclass(frozen=True)
class Registry[T]:
    """Names of one kind and where their objects are.

    A registry with a `subclass_of` or `instance_of` is open: it also takes "my_package.my_module:MyThing", if the
    caller allows that module (`demorec.core.user_modules`) and the thing is of the right kind.

    Attributes:
        kind: What a row is, in the singular, for messages ("task").
        rows: name -> "module:attribute".
        subclass_of: "module:attribute" of the class that the user's own classes must derive from.
        instance_of: "module:attribute" of the class that the user's own objects must be of.
    """

    kind: str
    rows: Mapping[str, str]
    subclass_of: str = ""
    instance_of: str = ""

    def names(self) -> tuple[str, ...]:
        """Every name, in the order of the table."""
        return tuple(self.rows)

    def check_name(self, name: str, allowed: Iterable[str] = ()) -> None:
        """Raise ConfigError with the nearest match unless `name` may be loaded; imports nothing.

        Args:
            name: A row's, or "package.module:Thing" where the registry is open.
            allowed: Modules and packages of the user's own that may be imported.

        Raises:
            NotAllowedError: It is a thing of a module that is not among those.
        """
        if name in self.rows:
            return
        is_open = bool(self.subclass_of or self.instance_of)
        parts = split_name(name) if is_open else None
        if parts is None:
            extra = ', or "package.module:Name" for one of your own' if is_open else ""
            raise ConfigError(
                f"Unknown {self.kind} {name!r}.{nearest_match(name, self.rows)} Allowed: {', '.join(self.rows)}{extra}."
            )
        if not is_allowed(parts[0], allowed):
            raise NotAllowedError(
                f"The {self.kind} {name!r} is code from outside of demorec that a file names, and only you can say "
                f"whether to run it: if you trust that module, add --allow {parts[0]}."
            )

    def load(self, name: str, allowed: Iterable[str] = ()) -> T:
        """Import and return the object called `name`; arguments as of `check_name`.

        Raises:
            ConfigError: No such name, or one of the user's own that cannot be imported or is of another kind.
            NotAllowedError: As `check_name`.
        """
        self.check_name(name, allowed)
        if name in self.rows:
            return cast(T, _import(self.rows[name]))
        found = import_object(self.kind, name)
        base = _import(self.subclass_of or self.instance_of)
        fits = isinstance(found, type) and issubclass(found, base) if self.subclass_of else isinstance(found, base)
        if not fits:
            relation = "a subclass" if self.subclass_of else "an instance"
            raise ConfigError(
                f"{name!r} is no {self.kind}: it must be {relation} of {base.__module__}.{base.__qualname__}."
            )
        if inspect.isabstract(found):
            missing = ", ".join(sorted(getattr(found, "__abstractmethods__", ())))
            raise ConfigError(f"The {self.kind} {name!r} is not complete: it lacks {missing}.")
        return cast(T, found)


def _import(target: str) -> Any:
    """The object of a table's "module:attribute"."""
    module_name, _, attribute = target.partition(":")
    return getattr(importlib.import_module(module_name), attribute)

"""Tables of things that a user names: tasks, robots, cameras, renderers, exporters, checks.

A row maps a name to "module:attribute", imported when it is used: listing what there is costs nothing, and a
heavy library is loaded only by the row that needs it.
"""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import cast

from demorec.errors import ConfigError


def nearest_match(name: str, allowed: Iterable[str]) -> str:
    """Return " Did you mean 'x'?" for the closest allowed name, or an empty string."""
    matches = difflib.get_close_matches(name, list(allowed), n=1, cutoff=0.5)
    return f" Did you mean {matches[0]!r}?" if matches else ""


@dataclass(frozen=True)
class Registry[T]:
    """Names of one kind and where their objects are.

    Attributes:
        kind: What a row is, in the singular, for messages ("task").
        rows: name -> "module:attribute".
        open_to_others: Whether "my_package.my_module:MyThing" is accepted beside the names.
    """

    kind: str
    rows: Mapping[str, str]
    open_to_others: bool = False

    def names(self) -> tuple[str, ...]:
        """Every name, in the order of the table."""
        return tuple(self.rows)

    def check_name(self, name: str) -> None:
        """Raise ConfigError with the nearest match unless `name` can be loaded; imports nothing."""
        if name in self.rows or (self.open_to_others and ":" in name):
            return
        extra = ', or "package.module:Name" for one of your own' if self.open_to_others else ""
        raise ConfigError(
            f"Unknown {self.kind} {name!r}.{nearest_match(name, self.rows)} Allowed: {', '.join(self.rows)}{extra}."
        )

    def load(self, name: str) -> T:
        """Import and return the object called `name`.

        Raises:
            ConfigError: No such name, or somebody else's module or attribute cannot be imported.
        """
        self.check_name(name)
        target = self.rows.get(name, name)
        module_name, _, attribute = target.partition(":")
        if name in self.rows:
            return cast(T, getattr(importlib.import_module(module_name), attribute))
        try:
            return cast(T, getattr(importlib.import_module(module_name), attribute))
        except (ImportError, AttributeError) as error:
            raise ConfigError(
                f"The {self.kind} {name!r} cannot be imported ({error}): give it as package.module:Name, with the "
                "package installed or its folder on PYTHONPATH."
            ) from error

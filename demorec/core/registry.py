"""Tables of names that users can choose (tasks, robots, cameras, renderers, exporters, checks), and the modules that
may be imported.

A row maps a name to "module:attribute", which is imported on use: listing costs nothing, and a heavy library is loaded
only by the row that needs it.

Besides the rows, users can name their own modules. Importing a module runs its code. It is imported only if the user
has named it in this call: by a flag (`--task my_tasks:Mine`, `--allow my_tasks`), in the given config file, or in
Python by a `GenerateConfig`. A name in a recording, a run, a dataset or a policy does not count: it needs the module in
`allowed`.
"""

from __future__ import annotations

import difflib
import importlib
import importlib.util
import inspect
import pkgutil
import sys
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, cast

from demorec.core.errors import ConfigError, NotAllowedError
from demorec.core.own_code import own_line

_LONGEST = 100
"""Maximum length of a name to compare; the cost grows with the product of both lengths and the number of names."""
_MOST_LISTED = 30
"""Maximum number of names in an error; for more, it names the command that lists them."""


def nearest_match(name: str, allowed: Iterable[str]) -> str:
    """Return " Did you mean 'x'?" for the closest allowed name, or an empty string."""
    few = [other for other in islice(allowed, 5 * _LONGEST) if len(other) <= _LONGEST]
    matches = difflib.get_close_matches(name, few, n=1, cutoff=0.5) if len(name) <= _LONGEST else []
    return f" Did you mean {matches[0]!r}?" if matches else ""


def check_choice[T: str](kind: str, name: str, allowed: Collection[T]) -> T:
    """Return `name` if it is allowed; otherwise ConfigError with the closest match."""
    for choice in allowed:
        if choice == name:
            return choice
    raise ConfigError(f"Unknown {kind} {name!r}.{nearest_match(name, allowed)} Allowed: {', '.join(allowed)}.")


@dataclass(frozen=True)
class Registry[T]:
    """Names of one kind ("task"), each with "module:attribute" of its object.

    A registry is open if `subclass_of` or `instance_of` names a class: it also accepts "my_package.my_module:MyThing",
    an object of that kind, if the caller allows its module.
    """

    kind: str
    rows: Mapping[str, str]
    subclass_of: str = ""
    instance_of: str = ""

    def names(self) -> tuple[str, ...]:
        """All names, in table order."""
        return tuple(self.rows)

    def target(self, name: str) -> str:
        """Return "module:attribute" of a name, which is the name itself for a user's object."""
        return self.rows.get(name, name)

    def check_name(self, name: str, allowed: Iterable[str] = ()) -> None:
        """Raise ConfigError with the closest match if `name` is not known; imports nothing.

        Raises:
            NotAllowedError: It is "package.module:Thing" of a module that is not `allowed`, itself or by a package.
        """
        if name in self.rows:
            return
        is_open = bool(self.subclass_of or self.instance_of)
        parts = split_name(name) if is_open else None
        if parts is None:
            extra = ', or "package.module:Name" for one of your own' if is_open else ""
            listed = ", ".join(self.rows) if len(self.rows) <= _MOST_LISTED else f"those of demorec list {self.kind}s"
            raise ConfigError(
                f"Unknown {self.kind} {name!r}.{nearest_match(name, self.rows)} Allowed: {listed}{extra}."
            )
        if not is_allowed(parts[0], allowed):
            raise NotAllowedError(
                f"The {self.kind} {name!r} is third-party code that a file names, and only you can decide "
                f"whether to run it: if you trust that module, add --allow {parts[0]}."
            )

    def load(self, name: str, allowed: Iterable[str] = ()) -> T:
        """Import and return the object called `name`.

        Raises:
            ConfigError: As in `check_name`, or a user's object cannot be imported or has the wrong type.
        """
        self.check_name(name, allowed)
        if name in self.rows:
            return cast(T, pkgutil.resolve_name(self.rows[name]))
        found = import_object(self.kind, name)
        base: Any = pkgutil.resolve_name(self.subclass_of or self.instance_of)
        fits = isinstance(found, type) and issubclass(found, base) if self.subclass_of else isinstance(found, base)
        if not fits:
            relation = "a subclass" if self.subclass_of else "an instance"
            raise ConfigError(
                f"{name!r} is not a {self.kind}: it must be {relation} of {base.__module__}.{base.__qualname__}."
            )
        if inspect.isabstract(found):
            missing = ", ".join(sorted(getattr(found, "__abstractmethods__", ())))
            raise ConfigError(f"The {self.kind} {name!r} is not complete: it lacks {missing}.")
        return cast(T, found)


def split_name(name: str) -> tuple[str, str] | None:
    """Split "package.module:Thing" into ("package.module", "Thing"); None if the name has another form."""
    module, _, attribute = name.partition(":")
    if attribute.isidentifier() and is_module_name(module):
        return module, attribute
    return None


def modules_of(names: Iterable[str]) -> tuple[str, ...]:
    """Modules of the names of the form "package.module:Thing", each once."""
    found = (split_name(name) for name in names)
    return tuple(dict.fromkeys(parts[0] for parts in found if parts is not None))


def is_foreign(module: str) -> bool:
    """Whether a module belongs to another package than demorec."""
    return module.partition(".")[0] != "demorec"


def is_allowed(module: str, allowed: Iterable[str]) -> bool:
    """Whether a module is allowed itself or by one of its packages."""
    return any(module == name or module.startswith(f"{name}.") for name in allowed)


def import_object(kind: str, name: str) -> object:
    """Import "package.module:Thing"; ConfigError if that fails for any reason. `kind` is for messages."""
    module_name, _, attribute = name.partition(":")
    make_importable(module_name)
    try:
        module = importlib.import_module(module_name)
        if hasattr(module, attribute):
            return getattr(module, attribute)
    except (Exception, SystemExit) as error:  # the user's code may raise anything
        reason = str(error) if isinstance(error, ImportError | AttributeError) else f"{type(error).__name__}: {error}"
        if line := own_line(error):
            raise ConfigError(f"The {kind} {name!r} cannot be imported ({reason}): mend {line}") from error
        raise ConfigError(
            f"The {kind} {name!r} cannot be imported ({reason}): give it as package.module:Name, with the package "
            "installed, its folder on PYTHONPATH, or the module in the current folder."
        ) from error
    raise ConfigError(
        f"The {kind} {name!r} cannot be imported, since the module has no such name."
        f"{nearest_match(attribute, vars(module))}"
    )


def make_importable(module: str) -> None:
    """Make a module of the current folder importable, as `python -m` does, unless it already is.

    The folder is appended to the path, so that installed modules take precedence; child processes inherit the path.
    """
    top = module.partition(".")[0]
    here = Path.cwd()
    if top in sys.modules or importlib.util.find_spec(top) is not None:
        return
    if (here / f"{top}.py").is_file() or (here / top).is_dir():
        sys.path.append(str(here))
        importlib.invalidate_caches()


def module_file(module: str) -> Path:
    """File of a module, or `__init__` file of a package; ConfigError if there is none.

    Imports the enclosing packages, so the module must be an allowed one.
    """
    make_importable(module)
    try:
        spec = importlib.util.find_spec(module)
    except (Exception, SystemExit) as error:  # an enclosing package is the user's code, too
        raise ConfigError(f"The module {module!r} cannot be found ({type(error).__name__}: {error}).") from error
    if spec is None or spec.origin is None or not Path(spec.origin).is_file():
        raise ConfigError(
            f"The module {module!r} has no file: install its package, put its folder on PYTHONPATH, or run the "
            "command in its folder."
        )
    return Path(spec.origin)


def import_root(module: str) -> Path:
    """Folder on the path in which a module was found; errors as in `module_file`."""
    file = module_file(module)
    return file.parents[module.count(".") + (file.stem == "__init__")]


def is_module_name(name: str) -> bool:
    """Whether a name is valid for a module or package."""
    return all(part.isidentifier() for part in name.split("."))

"""Things that a user names (tasks, robots, cameras, renderers, exporters, checks), and which modules may be imported.

A row of a table maps a name to "module:attribute", imported when it is used: listing what there is costs nothing, and a
heavy library is loaded only by the row that needs it.

Beside the tables' rows there are modules of the user's own. Importing a module runs it, so one is imported only when
the user has named it in this call: by a flag (`--task my_tasks:Mine`, `--allow my_tasks`), in the config file that was
given, or in Python by a `GenerateConfig`. What a recording, a run, a dataset or a policy names is no such word: it
needs the module in `allowed`.
"""

from __future__ import annotations

import difflib
import importlib
import importlib.util
import inspect
import sys
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, cast

from demorec.core.errors import ConfigError, NotAllowedError
from demorec.core.own_code import own_line

_LONGEST = 100
"""Characters of names that are compared with others, which takes the product of both and of how many there are."""
_MOST_LISTED = 30
"""Names that a refusal lists; of more it names the command that does."""


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
    caller allows that module (`demorec.core.registry`) and the thing is of the right kind.

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

    def target(self, name: str) -> str:
        """Return "module:attribute" of a name, which is the name itself for a thing of the user's own."""
        return self.rows.get(name, name)

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
            listed = ", ".join(self.rows) if len(self.rows) <= _MOST_LISTED else f"those of demorec list {self.kind}s"
            raise ConfigError(
                f"Unknown {self.kind} {name!r}.{nearest_match(name, self.rows)} Allowed: {listed}{extra}."
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


def split_name(name: str) -> tuple[str, str] | None:
    """("package.module", "Thing") of "package.module:Thing"; None unless the name is exactly of that form."""
    module, _, attribute = name.partition(":")
    if attribute.isidentifier() and is_module_name(module):
        return module, attribute
    return None


def modules_of(names: Iterable[str]) -> tuple[str, ...]:
    """The modules that those of the names which are "package.module:Thing" lie in, each once."""
    found = (split_name(name) for name in names)
    return tuple(dict.fromkeys(parts[0] for parts in found if parts is not None))


def is_foreign(module: str) -> bool:
    """Whether a module belongs to another package than demorec."""
    return module.partition(".")[0] != "demorec"


def is_allowed(module: str, allowed: Iterable[str]) -> bool:
    """Whether a module is one of those named, or lies in a package that is."""
    return any(module == name or module.startswith(f"{name}.") for name in allowed)


def import_object(kind: str, name: str) -> object:
    """Import the module of "package.module:Thing" and return the thing.

    Args:
        kind: What it is to be ("task"), for messages.
        name: Of the form that `split_name` takes.

    Raises:
        ConfigError: The module cannot be imported, whatever it raises, or has no such attribute.
    """
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
    """Let a module of the current folder be found, as `python -m` does, where it is not found without.

    The folder is appended to the path, so that nothing in it takes the place of what is installed; processes that are
    started later inherit it.
    """
    top = module.partition(".")[0]
    here = Path.cwd()
    if top in sys.modules or importlib.util.find_spec(top) is not None:
        return
    if (here / f"{top}.py").is_file() or (here / top).is_dir():
        sys.path.append(str(here))
        importlib.invalidate_caches()


def module_file(module: str) -> Path:
    """The file of a module; of a package, that of its `__init__`.

    Packages around it are imported on the way, so it must be an allowed one.

    Raises:
        ConfigError: There is no such module, or it has no file.
    """
    make_importable(module)
    try:
        spec = importlib.util.find_spec(module)
    except (Exception, SystemExit) as error:  # a package around it is the user's code, too
        raise ConfigError(f"The module {module!r} cannot be found ({type(error).__name__}: {error}).") from error
    if spec is None or spec.origin is None or not Path(spec.origin).is_file():
        raise ConfigError(
            f"There is no file of the module {module!r}: install its package, put its folder on PYTHONPATH, or run the "
            "command in the folder where it lies."
        )
    return Path(spec.origin)


def import_root(module: str) -> Path:
    """The folder on the path in which a module was found; errors as of `module_file`."""
    file = module_file(module)
    return file.parents[module.count(".") + (file.stem == "__init__")]


def is_module_name(name: str) -> bool:
    """Whether a module or package can be called so."""
    return all(part.isidentifier() for part in name.split("."))

"""Modules of the user's own, with tasks, robots and cameras from outside of demorec, and which of them may be imported.

Importing a module runs it. So one is imported only when the user has named it in this call: by a flag
(`--task my_tasks:Mine`, `--allow my_tasks`), in the config file that was given, or in Python by a `GenerateConfig`.
What a recording, a run, a dataset or a policy names is no such word: it needs the module in `allowed`.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

from demorec.core.errors import ConfigError


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


def is_allowed(module: str, allowed: Iterable[str]) -> bool:
    """Whether a module is one of those named, or lies in a package that is."""
    return any(module == name or module.startswith(f"{name}.") for name in allowed)


def check_allowed(names: Sequence[str]) -> None:
    """Raise ConfigError unless every name can be that of a module or package."""
    for name in names:
        if not is_module_name(name):
            parts = split_name(name)
            advice = f" Did you mean {parts[0]!r}?" if parts else ""
            raise ConfigError(f"--allow names a module or package, for example my_tasks, found {name!r}.{advice}")


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
        return getattr(importlib.import_module(module_name), attribute)
    except (Exception, SystemExit) as error:  # the user's code may raise anything
        reason = str(error) if isinstance(error, ImportError | AttributeError) else f"{type(error).__name__}: {error}"
        raise ConfigError(
            f"The {kind} {name!r} cannot be imported ({reason}): give it as package.module:Name, with the package "
            "installed, its folder on PYTHONPATH, or the module in the current folder."
        ) from error


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

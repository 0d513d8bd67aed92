"""The versions that decide an episode, and how two runs differ; what modules of the user's own are made of.

A module counts with its source and with that of what it imports of its own surroundings: modules of its own package
and, unless it is installed, modules of the folder that it lies in. Imports are read, not carried out. The files beside
a module that its source names in a string ("mug.obj", "data/heights.csv") count as well, and those that a model among
them names; a name that is put together while the program runs is not seen. A robot counts with its URDF and the meshes
that this names, too. What an installed distribution brings has its version as well.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import importlib.metadata
import os
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from demorec.core.errors import DemorecError
from demorec.core.registry import import_root, is_allowed, split_name
from demorec.core.tables import load_robot
from demorec.robots.assets import allow_models, asset_path, mesh_path

SOURCE = "source of "
"""Begins the name of a digest among versions: "source of my_tasks"."""
_INSTALLED = ("site-packages", "dist-packages")
_LONGEST_NAME = 256
_NAMES_IN_MODELS = {".urdf": [r'filename="([^"]+)"'], ".obj": [r"^mtllib (.+)$"], ".mtl": [r"^map_\w+ (.+)$"]}
"""How models name other files: suffix -> patterns."""


def own_versions(modules: Sequence[str], *, robot: str = "") -> dict[str, str]:
    """Name -> version, or digest (16 hex digits) of the source, of the user's own modules.

    Args:
        modules: That may be imported; none gives nothing.
        robot: Name of the robot; one of the user's own counts with its model, too.

    Raises:
        ConfigError: A module or the robot cannot be found or loaded.
        SceneError: The robot's model or one of its meshes is missing.
    """
    versions: dict[str, str] = {}
    for module in modules:
        versions[SOURCE + module] = source_digest(module)
        for distribution in _distributions().get(module.partition(".")[0], ()):
            versions[distribution] = importlib.metadata.version(distribution)
    if split_name(robot) is not None:
        allow_models(modules)
        urdf = load_robot(robot, modules).urdf
        if ":" in urdf:
            versions[SOURCE + urdf] = _model_digest(asset_path(urdf))
    return versions


def version_differences(there: Mapping[str, str], here: Mapping[str, str]) -> tuple[str, ...]:
    """One line for each version in which two differ."""
    lines = []
    for name in dict.fromkeys((*there, *here)):
        old, new = there.get(name, "nothing"), here.get(name, "nothing")
        if old == new:
            continue
        if name.startswith(SOURCE) and name in there and name in here:
            lines.append(f"the {name} has changed")
        else:
            lines.append(f"version of {name} is {old} there and {new} here")
    return tuple(lines)


def differences(
    there: Mapping[str, Any],
    there_versions: Mapping[str, str],
    here: Mapping[str, Any],
    here_versions: Mapping[str, str],
) -> tuple[str, ...]:
    """One line for each value in which two configs, as plain data, and their versions differ."""
    return (*plain_differences(there, here), *version_differences(there_versions, here_versions))


def plain_differences(there: Mapping[str, Any], here: Mapping[str, Any]) -> tuple[str, ...]:
    """The same for plain data."""
    old, new = _flat(there), _flat(here)
    return tuple(
        f"{key} is {_spelt(old, key)} there and {_spelt(new, key)} here"
        for key in dict.fromkeys((*old, *new))
        if _spelt(old, key) != _spelt(new, key)
    )


def _flat(plain: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in plain.items():
        if isinstance(value, Mapping):
            flat.update(_flat(value, f"{prefix}{key} "))
        else:
            flat[prefix + key] = value
    return flat


def _spelt(values: Mapping[str, Any], key: str) -> str:
    if key not in values:
        return "nothing"
    value = values[key]
    if isinstance(value, list | tuple):
        return " ".join(str(item) for item in value) or "none"
    return str(value)


def changed_sources(versions: Mapping[str, str], allowed: Collection[str]) -> tuple[str, ...]:
    """One line for each of the user's own modules and models that is another one now than in recorded versions.

    Args:
        versions: As recorded.
        allowed: Modules that may be looked at; about others, and those that are not there, nothing is said.
    """
    now: dict[str, str] = {}
    for name in (key.removeprefix(SOURCE) for key in versions if key.startswith(SOURCE)):
        module, _, model = name.partition(":")
        if is_allowed(module, allowed):
            with suppress(DemorecError, OSError):
                now[SOURCE + name] = _model_digest(asset_path(name)) if model else source_digest(name)
    return version_differences({name: versions[name] for name in now}, now)


@functools.cache
def source_digest(module: str) -> str:
    """SHA-256 (16 hex digits) of a module's source, of what it imports of its own surroundings, and of files they name.

    Kept as it was at the first call in a process, since that is also what the process has imported.

    Raises:
        ConfigError: The module cannot be found.
    """
    top, root = module.partition(".")[0], import_root(module)
    is_installed = root.name in _INSTALLED or root == Path(ast.__file__).parent
    waiting, sources, data = [module], dict[str, Path](), dict[str, Path]()
    while waiting:
        name = waiting.pop()
        if name in sources or (is_installed and name.partition(".")[0] != top):
            continue
        source = _file_of(name, root)
        if source is not None:
            sources[name] = source
            data |= {path.relative_to(root).as_posix(): path for path in _files_named(source, root)}
            waiting += _imports(source, name if source.stem == "__init__" else name.rpartition(".")[0])
            waiting += name.rpartition(".")[:1]  # the package around it, which is run first
    return _digest((name, path.read_bytes()) for name, path in (*sorted(sources.items()), *sorted(data.items())))


@functools.cache
def _distributions() -> Mapping[str, list[str]]:
    """Top-level module or package -> the installed distributions that it comes from."""
    return importlib.metadata.packages_distributions()


def _file_of(name: str, root: Path) -> Path | None:
    """The source of a module or package below `root`."""
    base = root.joinpath(*name.split("."))
    candidates = (base / "__init__.py", base.with_name(f"{base.name}.py")) if name else ()
    return next((path for path in candidates if path.is_file()), None)


def _imports(source: Path, package: str) -> Iterator[str]:
    """Every name that may be that of a module which the source imports; nothing where it is no Python."""
    for node in _nodes(source):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            around = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            base = ".".join([*around, node.module] if node.module else around)
            yield base
            yield from (f"{base}.{alias.name}" for alias in node.names)


def _files_named(source: Path, root: Path) -> Iterator[Path]:
    """The files below `root` that a string in a source names, relative to it, and those that models among them name."""
    names = {node.value for node in _nodes(source) if isinstance(node, ast.Constant) and isinstance(node.value, str)}
    waiting = [(source.parent, name) for name in names if 0 < len(name) < _LONGEST_NAME]
    seen: set[Path] = set()
    while waiting:
        folder, name = waiting.pop()
        path = Path(os.path.normpath(folder / name))
        try:
            is_new = path not in seen and path.is_relative_to(root) and path.is_file()
        except (OSError, ValueError):  # no name of a file
            continue
        if is_new:
            seen.add(path)
            yield path
            for pattern in _NAMES_IN_MODELS.get(path.suffix.lower(), ()):
                found = re.findall(pattern, path.read_text(errors="replace"), re.MULTILINE)
                waiting += [(path.parent, inner.strip()) for inner in found]


def _nodes(source: Path) -> Iterator[ast.AST]:
    """All of a source's syntax tree; nothing where it is no Python."""
    try:
        yield from ast.walk(ast.parse(source.read_bytes()))
    except (SyntaxError, ValueError):
        return


def _model_digest(urdf: Path) -> str:
    """Of a URDF and of the meshes that it names."""
    content = urdf.read_bytes()
    names = sorted(set(re.findall(r'filename="([^"]+)"', content.decode(errors="replace"))))
    return _digest([("", content), *((name, mesh_path(urdf.parent, name).read_bytes()) for name in names)])


def _digest(parts: Iterable[tuple[str, bytes]]) -> str:
    sha = hashlib.sha256()
    for name, content in parts:
        sha.update(f"{name}\0{len(content)}\0".encode() + content)
    return sha.hexdigest()[:16]

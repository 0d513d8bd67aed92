"""Versions that decide an episode, differences between two runs, and digests of the user's modules and models.

A module in a package counts with all files of its outermost package, any other module with its own file. A robot counts
with its URDF and the URDF's meshes. A module of an installed distribution also counts with its version.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.metadata
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from demorec.core.errors import ConfigError, DemorecError
from demorec.core.registry import import_root, is_allowed, is_foreign, module_file
from demorec.core.tables import ROBOTS, load_robot
from demorec.robots.assets import allow_models, asset_path, mesh_path
from demorec.robots.urdf import mesh_names

SOURCE = "source of "
"""Prefix of a digest's name among versions: "source of my_tasks"."""


def own_versions(modules: Sequence[str], *, robot: str = "") -> dict[str, str]:
    """Return name -> version, or source digest (16 hex digits), for the user's own modules.

    A user's own robot also counts with its model.

    Raises:
        ConfigError: A module or the robot cannot be found or loaded, or its model is not a URDF.
        SceneError: The robot's model or one of its meshes is missing.
    """
    versions: dict[str, str] = {}
    for module in modules:
        versions[SOURCE + module] = source_digest(module)
        for distribution in _distributions().get(module.partition(".")[0], ()):
            versions[distribution] = importlib.metadata.version(distribution)
    if robot and is_foreign(ROBOTS.target(robot)):
        allow_models(modules)
        urdf = load_robot(robot, modules).urdf
        if ":" in urdf:
            versions[SOURCE + urdf] = _model_digest(asset_path(urdf))
    return versions


def version_differences(there: Mapping[str, str], here: Mapping[str, str]) -> tuple[str, ...]:
    """One line per version that differs."""
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


def changed_sources(versions: Mapping[str, str], allowed: Collection[str]) -> tuple[str, ...]:
    """One line per allowed and existing module or model that has changed since these versions were recorded."""
    now: dict[str, str] = {}
    for name in (key.removeprefix(SOURCE) for key in versions if key.startswith(SOURCE)):
        module, _, model = name.partition(":")
        if is_allowed(module, allowed):
            with suppress(DemorecError, OSError):
                now[SOURCE + name] = _model_digest(asset_path(name)) if model else source_digest(name)
    return version_differences({name: versions[name] for name in now}, now)


@functools.cache
def source_digest(module: str) -> str:
    """Return the SHA-256 (16 hex digits) of a module's file, or of all files of its outermost package.

    A process keeps the digest of its first call, because that version is the one it has imported.
    """
    file, root = module_file(module), import_root(module)
    package = root / module.partition(".")[0]
    files = _files_below(package) if file.is_relative_to(package) else [file]
    return _digest((path.relative_to(root).as_posix(), path.read_bytes()) for path in files)


@functools.cache
def _distributions() -> Mapping[str, list[str]]:
    """Top-level module or package -> the installed distributions that provide it."""
    return importlib.metadata.packages_distributions()


def _files_below(package: Path) -> list[Path]:
    """List all files of a package in order, except hidden files and compiled modules."""
    files = [path for path in sorted(package.rglob("*")) if path.is_file()]
    names = {path: path.relative_to(package).parts for path in files}
    return [path for path in files if not any(name.startswith(".") or name == "__pycache__" for name in names[path])]


def _model_digest(urdf: Path) -> str:
    """Digest of a URDF and the meshes that it names."""
    content = urdf.read_bytes()
    try:
        names = mesh_names(content.decode(errors="replace"))
    except ValueError as error:
        raise ConfigError(f"The robot's model cannot be read ({error}): {urdf}") from error
    return _digest([("", content), *((name, mesh_path(urdf.parent, name).read_bytes()) for name in names)])


def _digest(parts: Iterable[tuple[str, bytes]]) -> str:
    sha = hashlib.sha256()
    for name, content in parts:
        sha.update(f"{name}\0{len(content)}\0".encode() + content)
    return sha.hexdigest()[:16]

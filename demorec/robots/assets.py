"""Lookup of model files, without the simulator: pybullet_data's, demorec's and those of the user's modules.

A recording names its models independently of the machine: a path below pybullet_data, "demorec:NAME", or
"my_robots:PATH" for a file next to a user's module. A name never leads out of these folders, and into a module's only
if the user has allowed it.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import importlib.util
import os
from collections.abc import Iterable, Iterator
from pathlib import Path

from demorec.core.errors import ConfigError, MissingDependencyError, NotAllowedError, SceneError
from demorec.core.extension import extension_packages
from demorec.core.files import cache_folder, write_whole
from demorec.core.registry import import_root, is_allowed, is_module_name, module_file
from demorec.episode.mesh import decode_mesh
from demorec.episode.scene import Shape

OWN_PREFIX = "demorec:"

_PACKAGE_SCHEMES = ("package", "model")
"""Schemes of ROS and of Gazebo: the first part of the path is the name of a package or model."""
_MAX_FOLDERS_ABOVE = 6
"""Number of searched folders above a URDF, its own included: PACKAGE/robots/ARM/urdf/arm.urdf is the deepest usual
layout, and a workspace adds one."""

_modules_with_models: set[str] = set()
"""Global to the process, like `sys.path`: models are looked up deep inside the code that reads or draws recordings."""


def allow_models(modules: Iterable[str]) -> None:
    """Allow model files next to these user modules for the rest of the process."""
    _modules_with_models.update(modules)


@functools.cache
def data_folder() -> Path:
    """Return the folder of pybullet_data; MissingDependencyError if it is not installed."""
    spec = importlib.util.find_spec("pybullet_data")
    if spec is None or spec.origin is None:
        raise MissingDependencyError("Loading robot models", "pybullet", "pip install pybullet")
    return Path(spec.origin).parent


def asset_path(name: str) -> Path:
    """Resolve a path below pybullet_data, "demorec:NAME" (of `demorec/sim/assets`) or "module:PATH".

    Raises:
        SceneError: The file does not exist, or the name leads out of its folder.
        NotAllowedError: It is next to a module that the user has not allowed (`allow_models`).
        ConfigError: That module cannot be found.
    """
    module, _, relative = name.rpartition(":")
    if modules_of_models([name]):
        if not is_allowed(module, _modules_with_models | extension_packages()):
            raise NotAllowedError(
                f"The model {name!r} is next to a module outside demorec: if you trust that module, add "
                f"--allow {module}."
            )
        file = module_file(module)
        folder, limit = file.parent, _top_folder(module)
    else:
        folder = limit = Path(__file__).parent.parent / "sim" / "assets" if module else data_folder()
    path = Path(os.path.normpath(folder / relative))
    if not path.is_relative_to(limit):
        raise SceneError(f"The model file {name!r} is outside {limit}: move it there.")
    if not path.is_file():
        raise SceneError(
            f"The model file {name!r} does not exist: give a path below pybullet_data, demorec:NAME, or a file next to "
            "your module."
        )
    return path


def surface_file(shape: Shape) -> Path:
    """Return the file that a mesh is drawn from: its own, or a cached copy of the recorded mesh.

    Raises as `asset_path`, and SceneError for a broken recorded mesh.
    """
    return _written_mesh(shape.mesh)[0] if shape.mesh else asset_path(shape.file)


def collision_file(shape: Shape) -> Path:
    """Return the file for a mesh's collisions, with the convex hull of each object; raises as `surface_file`."""
    return _written_mesh(shape.mesh)[1] if shape.mesh else asset_path(shape.file)


@functools.lru_cache(maxsize=1024)
def _written_mesh(text: str) -> tuple[Path, Path]:
    """Write the surface and the convex parts of a mesh in the scene to files named after their content."""
    mesh = decode_mesh(text)
    folder, digest = cache_folder("objects"), hashlib.sha256(text.encode()).hexdigest()[:32]
    surface, parts = (folder / f"{digest}{suffix}.obj" for suffix in ("", "_parts"))
    for path, content in ((surface, mesh.surface_obj()), (parts, mesh.parts_obj())):
        # A file left by another process may be truncated or edited, and would affect the recording.
        if not path.is_file() or path.read_text() != content:
            write_whole(path, lambda temporary, content=content: temporary.write_text(content))  # type: ignore[misc]
    return surface, parts


def modules_of_models(names: Iterable[str]) -> tuple[str, ...]:
    """List the user modules that contain these models, each once."""
    modules = (name.rpartition(":")[0] for name in names)
    return tuple(dict.fromkeys(m for m in modules if f"{m}:" != OWN_PREFIX and is_module_name(m)))


def model_name(file: str | Path, module: str) -> str:
    """Build the recorded name of a model given by a user's module.

    The file is absolute, relative to the module's file, below pybullet_data, or "demorec:NAME". Raises ConfigError for
    an absolute path that is neither next to the module (or in its package) nor in pybullet_data.
    """
    name = str(file)
    if ":" in name:
        return name
    folder = module_file(module).parent
    path = Path(os.path.normpath(folder / name))
    if path.is_file() and path.is_relative_to(_top_folder(module)):
        return f"{module}:{os.path.relpath(path, folder)}"
    if not Path(name).is_absolute():
        return name
    if path.is_relative_to(data_folder()):
        return path.relative_to(data_folder()).as_posix()
    raise ConfigError(
        f"The module {module!r} names a model outside its own folder and pybullet_data, which other machines "
        f"could not find: put it next to the module, found {name}"
    )


def mesh_path(folder: Path | None, name: str) -> Path:
    """Resolve the path of a mesh named by a URDF.

    A name is looked up next to the URDF and below pybullet_data. A ROS name ("package://PACKAGE/meshes/base.stl", or a
    "file://" path into an installed package) is also looked up in the folders above the URDF, as in a workspace or a
    repository of that package, and in the packages of ROS_PACKAGE_PATH and AMENT_PREFIX_PATH.

    Args:
        folder: Folder of the URDF. None for a URDF of unknown origin: its names are resolved only in pybullet_data, the
            current folder, the folders of allowed modules, and ROS packages.
        name: Name in the URDF.

    Raises:
        SceneError: The file does not exist.
    """
    scheme, separator, path = name.rpartition("://")
    relative = path if separator else name
    parts = _package_path(scheme, relative)
    for candidate in _mesh_candidates(folder, relative, parts):
        if candidate.is_file():
            return candidate
    fix = f"put the package {parts[0]!r} next to it or on ROS_PACKAGE_PATH" if parts else "put it there"
    where = "" if folder is None else f": {folder}"
    raise SceneError(f"The mesh {name!r} is neither next to its URDF nor in pybullet_data, {fix}{where}")


def _mesh_candidates(folder: Path | None, relative: str, parts: tuple[str, ...]) -> Iterator[Path]:
    """Yield the candidate paths of a mesh, most likely first; `parts` as in `_package_path`."""
    if folder is not None:
        yield folder / relative
        yield folder.parent / relative
        yield data_folder() / relative
        folders = [folder]
    else:
        folders = [Path.cwd()]
        for module in sorted(_modules_with_models):
            with contextlib.suppress(ConfigError):  # a module that does not exist here has no meshes
                folders.append(module_file(module).parent)
        if not Path(relative).is_absolute() and ".." not in Path(relative).parts:
            yield from (place / relative for place in (*folders, data_folder()))
    if not parts or ".." in parts:
        return
    for start in folders:
        for above in [start, *start.parents][:_MAX_FOLDERS_ABOVE]:
            yield above.joinpath(*parts)
            yield above.joinpath(*parts[1:])  # a repository named differently from its package
    yield from (package.joinpath(*parts[1:]) for package in _ros_packages(parts[0]))


def _package_path(scheme: str, path: str) -> tuple[str, ...]:
    """Split a ROS name into its package and the parts of the path in it; () for a name of another kind."""
    if scheme == "file":
        *_, path = path.rpartition("/share/")
        scheme = "" if path.startswith("/") else "package"  # of a path outside installed packages
    parts = Path(path).parts if scheme in _PACKAGE_SCHEMES else ()
    return parts if len(parts) > 1 else ()


def _ros_packages(name: str) -> Iterator[Path]:
    """Yield the folders that ROS 1 and ROS 2 on this machine would use for a package."""
    for entry in filter(None, os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep)):
        yield Path(entry) / name
        if Path(entry).name == name:
            yield Path(entry)
    for entry in filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)):
        yield Path(entry) / "share" / name


def remember_model(description: str, urdf: Path) -> None:
    """Store the file that a recorded description comes from in the cache, to draw the robot with its meshes here.

    A recording has no paths; an unwritable cache only loses the meshes.
    """
    text = str(urdf.resolve())
    with contextlib.suppress(OSError, UnicodeError):
        write_whole(_remembered(description), lambda temporary: temporary.write_text(text))


def known_model(description: str) -> Path | None:
    """Return the file that a recorded description comes from; None if unknown or deleted."""
    with contextlib.suppress(OSError, ValueError):
        path = Path(_remembered(description).read_text())
        return path if path.is_file() else None
    return None


def _remembered(description: str) -> Path:
    return cache_folder("robots") / hashlib.sha256(description.encode()).hexdigest()[:32]


def _top_folder(module: str) -> Path:
    """Find the folder of the outermost package that contains a module, or that of its file."""
    root = import_root(module)
    package = root / module.partition(".")[0]
    return package if module_file(module).is_relative_to(package) else root

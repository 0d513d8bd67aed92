"""A mapping suggested from the contents of an HDF5 file: every dataset listed, every number placed.

Supports the layouts of robomimic, Isaac Lab (robomimic's, with the simulator's state), ALOHA, and groups at the root
that are episodes. Settings that neither the file nor the layout specifies are commented out.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from demorec.core.errors import without_path
from demorec.episode.features import EE_POSE, STATE
from demorec.episode.roles import HDF5_PARTS
from demorec.extensions.imports.hdf5_arrays import is_camera
from demorec.extensions.imports.hdf5_file import ForeignFile, Hdf5Error, StoredArray
from demorec.extensions.imports.hdf5_import import episode_places, found_attribute, stated_rate
from demorec.extensions.imports.mapping import Episodes
from demorec.extensions.imports.words import quoted, task_in_name, unique_name
from demorec.runs.find import expect

_ARTICULATION = re.compile(r"states/articulation/[^/]+/joint_position")
"""Absolute joint positions of Isaac Lab; its observation joint_pos is relative to the default pose."""
_ISAAC_NAMES = (
    (4, re.compile(r"(^|_)(quat|orientation)$"), ("qw", "qx", "qy", "qz")),
    (7, re.compile(r"(^|/)root_pose$"), ("x", "y", "z", "qw", "qx", "qy", "qz")),
)
"""Number and names of the elements of Isaac Lab's orientations and poses, by the dataset's name."""
_MAX_SHOWN = 4
"""Maximum entries of a file that an error lists."""
_ALOHA_FPS = 50
"""ALOHA's recorders take a row every `DT = 0.02` seconds, which their files do not record."""
_TASKS = ("instruction", "ep_meta.lang", "problem_info.language_instruction", "language_instruction")
_NO_STATE = "# No dataset is known to be the robot's state: take one of those above."
_STATES = ("state", "states", "observation", "observations", "obs", "qpos")
"""Names of the state in groups at the root."""


@dataclass(frozen=True, kw_only=True)
class _Layout:
    """Location of a file's episodes and names of their datasets.

    Attributes:
        group: Value of `episodes.group`; "" if the file is one episode.
        actions: Names of datasets that belong to the action.
        folder: Prefix of observations; "" if every other dataset is one.
    """

    group: str
    actions: tuple[str, ...]
    folder: str


_ALOHA = _Layout(group="", actions=("action", "base_action"), folder="observations/")
_ROBOMIMIC = _Layout(group="data", actions=("actions",), folder="obs/")
_GROUPS_AT_ROOT = _Layout(group="/", actions=("action", "actions"), folder="")


def _layout_of(file: ForeignFile) -> _Layout | None:
    """Find the layout of a file; None for an unknown one."""
    if file.has("action") and file.is_group("observations"):
        return _ALOHA
    if file.is_group(_ROBOMIMIC.group):
        return _ROBOMIMIC
    groups = [name for name, kind in file.children("").items() if kind == "group"]
    has_actions = [any(file.has(f"{group}/{name}") for name in _GROUPS_AT_ROOT.actions) for group in groups]
    return _GROUPS_AT_ROOT if groups and all(has_actions) else None


class _Contents:
    """An episode of a file: its datasets by relative name, the cameras among them, and reasons why others cannot be
    used.
    """

    def __init__(self, file: ForeignFile, place: str) -> None:
        self.file, self.place = file, place
        self.arrays: dict[str, StoredArray] = {}
        self.cameras: list[str] = []
        self.unusable: list[str] = []
        for dataset in file.datasets(place):
            try:
                name, array = dataset.removeprefix(place).lstrip("/"), file.array(dataset, may_be_ragged=True)
                if is_camera(array):
                    self.cameras.append(name)
                self.arrays[name] = array
            except Hdf5Error as error:
                self.unusable.append(without_path(error, file.path))

    def text(self, name: str) -> str:
        """Text of an attribute; "" if it is missing, blank or not text."""
        found = found_attribute(self.file, self.place, name)
        return found if isinstance(found, str) and found.strip() else ""

    def is_vector(self, name: str) -> bool:
        """Whether it holds rows of numbers."""
        array = self.arrays[name]
        return len(array.shape) <= 2 and not array.is_ragged and name not in self.cameras


def summarize_hdf5(path: Path) -> dict[str, Any]:
    """Summarise a file for `demorec info --json`: episodes, rate, and datasets of the first episode.

    For an unknown layout all datasets are listed, and the number of episodes is None.
    """
    with ForeignFile(path) as file:
        layout = _layout_of(file)
        places = [""] if layout is None else episode_places(file, Episodes(group=layout.group))
        contents = _Contents(file, places[0])
        actions = [name for name in contents.arrays if layout is not None and name in layout.actions]
        problems, rows = contents.unusable, 0
        for place in places if actions else ():
            try:
                rows += len(file.array(f"{place}/{actions[0]}".lstrip("/")))
            except Hdf5Error as error:
                problems.append(without_path(error, path))
        return {
            "kind": "hdf5",
            "path": str(path),
            "bytes": path.stat().st_size,
            "episodes": None if layout is None else len(places),
            "rows": rows,
            "rate": stated_rate(file, places[0]),
            "datasets": [
                {"dataset": name, "dtype": array.dtype.name, "shape": list(array.shape)}
                for name, array in contents.arrays.items()
            ],
            "problems": problems,
        }


def suggested_hdf5_mapping(path: Path, tell: Callable[[str], None]) -> list[str]:
    """Return the lines of a mapping for a file, with comments about its content.

    Args:
        path: The file.
        tell: Called with each decision that the user must make before using the mapping.

    Raises:
        ConfigError: The file is missing.
        Hdf5Error: It cannot be read, or has another layout.
    """
    expect(path, "hdf5")
    with ForeignFile(path) as file:
        layout = _layout_of(file)
        if layout is None:
            held = ", ".join(list(file.children(""))[:_MAX_SHOWN]) or "nothing"
            raise Hdf5Error(
                "The layout is not robomimic's or Isaac Lab's (data/demo_0/actions), ALOHA's (action, "
                "observations/qpos), nor one with a group with actions for each episode; the file holds "
                f"{held}: write the mapping by hand (docs/import.md): {path}"
            )
        places = episode_places(file, Episodes(group=layout.group))
        contents = _Contents(file, places[0])
        lines = [f"# A mapping for {path.name}, suggested from its content; docs/import.md explains every key.", "#"]
        lines += [*_listed(contents, len(places)), ""]
        arguments = "env_args.env_kwargs"
        robot = contents.text(f"{arguments}.robot") or contents.text(f"{arguments}.robots.0") or "robot"
        lines += ["[robot]", f"name = {quoted(robot)}", '# urdf = "robot.urdf"', ""]
        lines += ["[task]", *_task(contents, path), ""]
        lines += ["[clock]", *_clock(contents, layout), ""]
        lines += ["[episodes]", *_episodes(contents, places, layout)]
        features = [*_features(contents, layout)]
        if _NO_STATE in features:
            tell(_NO_STATE.removeprefix("# "))
        if not any(name in contents.arrays for name in layout.actions):
            tell("No dataset is known to be the action: write [[features.action]].")
        return [*lines, *features, *_cameras(contents, layout)]


def _listed(contents: _Contents, count: int) -> Iterator[str]:
    """Yield a line for every dataset of the first episode with its type and shape."""
    where = f"{contents.place}, the first of {count} episodes" if contents.place else "the file, which is an episode"
    yield f"# Content of {where}:"
    for name, array in contents.arrays.items():
        length = " of variable length" if array.is_ragged else ""
        yield f"#   {name}  {array.dtype.name} {'x'.join(map(str, array.shape))}{length}"
    yield from (f"#   {reason}" for reason in contents.unusable)


def _is_observed(name: str, layout: _Layout) -> bool:
    return name not in layout.actions and name.startswith(layout.folder)


def _task(contents: _Contents, path: Path) -> list[str]:
    for name in _TASKS:
        if found := contents.text(name):
            return [f"attribute = {quoted(name)}  # {quoted(found[:60])}"]
    text = contents.text("env_args.env_name") or task_in_name(path.stem)
    if text in ("", "episode"):  # episode_0.hdf5, in a folder named after the task
        text = task_in_name(path.absolute().parent.name) or path.stem
    return [f"text = {quoted(text)}  # what the robot was asked to do", "# file_name = true"]


def _clock(contents: _Contents, layout: _Layout) -> list[str]:
    rate = stated_rate(contents.file, contents.place)
    if rate is not None:
        return [f"# fps = {rate:g}  # from the file"]
    if layout is _ALOHA:
        return [f"fps = {_ALOHA_FPS}  # of ALOHA's recorders (DT = 0.02); the file does not record it"]
    return ["# fps = 20  # rows a second, which the file does not record: look it up"]


def _episodes(contents: _Contents, places: Sequence[str], layout: _Layout) -> Iterator[str]:
    if layout is _ALOHA:
        yield "# The file is one episode."
        return
    yield f"group = {quoted(layout.group)}"
    if any(contents.file.attribute(place, "success") is not None for place in places):
        yield 'success = "success"'
    elif "rewards" in contents.arrays:
        yield '# success = "rewards"  # where the last one above 0 means a success'


def _features(contents: _Contents, layout: _Layout) -> Iterator[str]:
    vectors = [name for name in contents.arrays if contents.is_vector(name)]
    absolute, known = [name for name in vectors if _ARTICULATION.fullmatch(name)], list(HDF5_PARTS.values())
    observed: dict[str, list[str]] = {STATE: absolute} if absolute else {}
    if absolute:
        yield from ("", "# Isaac Lab: obs/joint_pos is relative to the default pose, so the state is the simulator's;")
        yield "# its quaternions are w, x, y, z."
    for name in sorted((name for name in vectors if _is_observed(name, layout)), key=_number_of_part):
        last, number = name.removeprefix(layout.folder), _number_of_part(name)
        feature = known[number] if number < len(known) else f"observation.{_word(last)}"
        if layout is _GROUPS_AT_ROOT and last in _STATES:
            feature = STATE
        if absolute and feature == STATE:
            feature = f"observation.{_word(last)}"
        observed.setdefault(feature, []).append(name)
    if STATE not in observed and EE_POSE in observed:
        observed[STATE] = observed.pop(EE_POSE)
    if STATE not in observed:
        yield from ("", _NO_STATE)
    observed["action"] = [name for name in layout.actions if name in vectors]
    for feature in sorted(observed, key=lambda name: name != STATE):
        key = feature if "." not in feature else quoted(feature)
        for name in observed[feature]:
            yield from ("", f"[[features.{key}]]", f"dataset = {quoted(name)}")
            for count, ending, names in _ISAAC_NAMES if absolute else ():
                if contents.arrays[name].shape[1:] == (count,) and ending.search(name):
                    yield f"names = [{', '.join(map(quoted, names))}]"


def _number_of_part(name: str) -> int:
    """Place of a dataset among the known parts of features: joints before grippers, positions before orientations."""
    last = name.rpartition("/")[2]
    found = (number for number, end in enumerate(HDF5_PARTS) if last == end or last.endswith(f"_{end}"))
    return next(found, len(HDF5_PARTS))


def _word(name: str) -> str:
    """Convert to the name of a feature or camera: letters, digits and _, beginning with a letter."""
    word = "".join(letter if letter.isascii() and letter.isalnum() else "_" for letter in name).strip("_")
    return word if word[:1].isalpha() else f"x_{word}"


def _cameras(contents: _Contents, layout: _Layout) -> Iterator[str]:
    taken: list[str] = []
    for name in (name for name in contents.cameras if _is_observed(name, layout)):
        camera = unique_name(_word(name.rpartition("/")[2].removesuffix("_image")), taken)
        taken.append(camera)
        yield from ("", f"[cameras.{camera}]", f"dataset = {quoted(name)}")
        if len(contents.arrays[name].shape) <= 2:
            yield '# colors = "bgr"  # where red and blue are exchanged in the images, as recorders with OpenCV do'

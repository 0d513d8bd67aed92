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

import numpy as np

from demorec.core.errors import without_path
from demorec.episode.features import EE_POSE, STATE
from demorec.episode.roles import HDF5_PARTS
from demorec.extensions.imports.hdf5_arrays import is_camera
from demorec.extensions.imports.hdf5_file import ForeignFile, Hdf5Error, StoredArray
from demorec.extensions.imports.hdf5_import import episode_places, found_attribute, stated_rate
from demorec.extensions.imports.mapping import Episodes
from demorec.extensions.imports.words import SHOWN, first_numbers, quoted, task_in_name, unique_name
from demorec.runs.find import expect

_ROBOMIMIC = "data"
_ARTICULATION = re.compile(r"states/articulation/[^/]+/joint_position")
"""Absolute joint positions of Isaac Lab; its observation joint_pos is relative to the default pose."""
_ISAAC_QUATERNION = re.compile(r"(^|_)(quat|orientation)$")
_ISAAC_POSE = re.compile(r"(^|/)root_pose$")
_W_FIRST = ("qw", "qx", "qy", "qz")
_ALOHA_FPS = 50
"""ALOHA's recorders take a row every `DT = 0.02` seconds, which their files do not record."""
_ALOHA_JOINTS = ("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate", "gripper")
_TASKS = ("instruction", "ep_meta.lang", "problem_info.language_instruction", "language_instruction")
_NO_STATE = "# No dataset is known to be the robot's state: take one of those above."
_ROBOTS = ("env_args.env_kwargs.robot", "env_args.env_kwargs.robots", "env_args.env_kwargs.robots.0")


@dataclass(frozen=True, kw_only=True)
class _Layout:
    """Location of a file's episodes and names of their datasets.

    Attributes:
        group: Value of `episodes.group`.
        actions: Names of datasets that belong to the action.
        folder: Prefix of observations; "" if every other dataset is one.
        states: Names of datasets that are the state, if their feature does not follow from the name's end.
        is_aloha: Whether the file is one episode of ALOHA's recorder.
    """

    group: str
    actions: tuple[str, ...]
    folder: str
    states: tuple[str, ...] = ()
    is_aloha: bool = False


_ALOHA = _Layout(group="", actions=("action", "base_action"), folder="observations/", is_aloha=True)
_LAYOUT_OF_ROBOMIMIC = _Layout(group=_ROBOMIMIC, actions=("actions",), folder="obs/")
_GROUPS_AT_ROOT = _Layout(
    group="/",
    actions=("action", "actions"),
    folder="",
    states=("state", "states", "observation", "observations", "obs", "qpos"),
)


def _layout_of(file: ForeignFile) -> _Layout | None:
    """Find the layout of a file; None for an unknown one."""
    if file.has("action") and file.is_group("observations"):
        return _ALOHA
    if file.is_group(_ROBOMIMIC):
        return _LAYOUT_OF_ROBOMIMIC
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

    Raises:
        Hdf5Error: It cannot be read.
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
            held = ", ".join(list(file.children(""))[:SHOWN]) or "nothing"
            raise Hdf5Error(
                "The layout is not robomimic's or Isaac Lab's (data/demo_0/actions), ALOHA's (action, "
                "observations/qpos), nor one with a group with actions for each episode; the file holds "
                f"{held}: write the mapping by hand (docs/import.md): {path}"
            )
        places = episode_places(file, Episodes(group=layout.group))
        contents = _Contents(file, places[0])
        lines = [f"# A mapping for {path.name}, suggested from its content; docs/import.md explains every key.", "#"]
        lines += [*_listed(contents, len(places)), ""]
        lines += ["[robot]", f"name = {quoted(_robot(contents, layout))}", *_model(contents), ""]
        lines += ["[task]", *_task(contents, path), ""]
        lines += ["[clock]", *_clock(contents, layout), ""]
        lines += ["[episodes]", *_episodes(contents, places, layout)]
        features = [*_features(contents, layout)]
        if _NO_STATE in features:
            tell(_NO_STATE.removeprefix("# "))
        return [*lines, *features, *_cameras(contents, layout)]


def _listed(contents: _Contents, count: int) -> Iterator[str]:
    """Yield lines for every dataset of the first episode with its shape and first numbers."""
    where = f"{contents.place}, the first of {count} episodes" if contents.place else "the file, which is an episode"
    yield f"# Content of {where}:"
    for name, array in contents.arrays.items():
        length = " of variable length" if array.is_ragged else ""
        yield f"#   {name}  {array.dtype.name} {'x'.join(map(str, array.shape))}{length}"
        if contents.is_vector(name) and array.shape[0]:
            try:
                yield f"#     {first_numbers(np.ravel(array.read(0, 1)))}"
            except Hdf5Error as error:
                yield f"#     {without_path(error, contents.file.path)}"
    for reason in contents.unusable:
        yield f"#   {reason}"


def _is_observed(name: str, layout: _Layout) -> bool:
    return name not in layout.actions and name.startswith(layout.folder)


def _robot(contents: _Contents, layout: _Layout) -> str:
    for name in _ROBOTS:
        if text := contents.text(name):
            return text
    return "aloha" if layout.is_aloha else "robot"


def _model(contents: _Contents) -> list[str]:
    is_urdf = "<robot" in contents.text("model_file")[:1000]  # robosuite's models are MuJoCo's
    return ['urdf_attribute = "model_file"'] if is_urdf else ['# urdf = "robot.urdf"']


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
    if layout.is_aloha:
        return [f"fps = {_ALOHA_FPS}  # of ALOHA's recorders (DT = 0.02); the file does not record it"]
    return ["# fps = 20  # rows a second, which the file does not record: look it up"]


def _episodes(contents: _Contents, places: Sequence[str], layout: _Layout) -> Iterator[str]:
    if layout.is_aloha:
        yield "# The file is one episode."
        return
    yield f"group = {quoted(layout.group)}"
    masks = list(contents.file.children("mask")) if contents.file.is_group("mask") else []
    if masks:
        yield f"# mask = {quoted(masks[0])}  # only those that one of these lists: {', '.join(map(quoted, masks))}"
    if any(contents.file.attribute(place, "success") is not None for place in places):
        yield 'success = "success"'
    elif "rewards" in contents.arrays:
        yield '# success = "rewards"  # where the last one above 0 means a success'


def _features(contents: _Contents, layout: _Layout) -> Iterator[str]:
    vectors = [name for name in contents.arrays if contents.is_vector(name)]
    absolute = [name for name in vectors if _ARTICULATION.fullmatch(name)]
    observed: dict[str, list[str]] = {STATE: absolute} if absolute else {}
    if absolute:
        yield from ("", "# Isaac Lab: obs/joint_pos is relative to the default pose, so the state is the simulator's;")
        yield "# its quaternions are w, x, y, z."
    for name in (name for name in vectors if _is_observed(name, layout)):
        last = name.removeprefix(layout.folder)
        known = (feature for end, feature in HDF5_PARTS.items() if last == end or last.endswith(f"_{end}"))
        feature = STATE if last in layout.states else next(known, f"observation.{_word(last)}")
        if absolute and feature == STATE:
            feature = f"observation.{_word(last)}"
        observed.setdefault(feature, []).append(name)
    if STATE not in observed and EE_POSE in observed:
        observed[STATE] = observed.pop(EE_POSE)
    if STATE not in observed:
        yield from ("", _NO_STATE)
    for feature in sorted(observed, key=lambda name: name != STATE):
        yield from _parts(feature, sorted(observed[feature], key=_order), contents, is_isaac=bool(absolute))
    yield from _parts("action", [name for name in layout.actions if name in vectors], contents)
    if "states" in vectors and not _is_observed("states", layout):
        yield from (f"# {line}" if line else "" for line in _parts("observation.simulator", ["states"], contents))


def _order(name: str) -> tuple[str, int]:
    """Sort key for the parts of a feature: robot by robot, the arm before its gripper, positions before
    orientations.
    """
    last = name.rpartition("/")[2]
    ends = [index for index, end in enumerate(HDF5_PARTS) if last == end or last.endswith(f"_{end}")]
    robot = last.removesuffix(list(HDF5_PARTS)[ends[0]]) if ends else last
    return robot, ends[0] if ends else 0


def _word(name: str) -> str:
    """Convert to the name of a feature or camera: letters, digits and _, beginning with a letter."""
    word = "".join(letter if letter.isascii() and letter.isalnum() else "_" for letter in name).strip("_")
    return word if word[:1].isalpha() else f"x_{word}"


def _parts(feature: str, names: Sequence[str], contents: _Contents, *, is_isaac: bool = False) -> Iterator[str]:
    key = feature if "." not in feature else quoted(feature)
    for name in names:
        yield from ("", f"[[features.{key}]]", f"dataset = {quoted(name)}")
        count = int(np.prod(contents.arrays[name].shape[1:]))
        if is_isaac and count == 4 and _ISAAC_QUATERNION.search(name):
            yield f"names = [{', '.join(map(quoted, _W_FIRST))}]"
        elif is_isaac and count == 7 and _ISAAC_POSE.search(name):
            yield f"names = [{', '.join(map(quoted, ('x', 'y', 'z', *_W_FIRST)))}]"
        if name in ("observations/qpos", "action") and contents.arrays[name].shape[1:] == (2 * len(_ALOHA_JOINTS),):
            joints = [f"{side}_{joint}" for side in ("left", "right") for joint in _ALOHA_JOINTS]
            yield f"# names = [{', '.join(map(quoted, joints))}]  # of ALOHA's two arms"


def _cameras(contents: _Contents, layout: _Layout) -> Iterator[str]:
    taken: list[str] = []
    for name in (name for name in contents.cameras if _is_observed(name, layout)):
        camera = unique_name(_word(name.rpartition("/")[2].removesuffix("_image")), taken)
        taken.append(camera)
        yield from ("", f"[cameras.{camera}]", f"dataset = {quoted(name)}")
        if len(contents.arrays[name].shape) <= 2:
            yield '# colors = "bgr"  # where red and blue are exchanged in the images, as recorders with OpenCV do'

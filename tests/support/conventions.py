"""LeRobot datasets under the names of other projects, by PyArrow and JSON alone: a moving arm, no images."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from support.drawn_datasets import write_tables
from support.foreign_dataset import COUNTERS, counters

FPS, LENGTH, EPISODES, LATE = 30, 120, 4, 3
JOINTS = ("shoulder", "elbow", "wrist", "gripper")


@dataclass(frozen=True)
class Convention:
    """Names under which a project writes the same motion.

    Attributes:
        state, action: Feature -> (names in info.json, columns of `arm_motion` that it holds), in order.
        modality: GR00T's modality.json.
        others: Feature -> number of elements; the values are noise.
        version: Version of the format.
    """

    state: Mapping[str, tuple[Any, tuple[int, ...]]]
    action: Mapping[str, tuple[Any, tuple[int, ...]]]
    modality: Mapping[str, Any] | None = None
    others: Mapping[str, int] = field(default_factory=dict)
    version: str = "v3.0"


def _whole(state: str, action: str, names: Any = JOINTS, **more: Any) -> Convention:
    columns = tuple(range(len(JOINTS)))
    return Convention({state: (names, columns)}, {action: (names, columns)}, **more)


ARM, HAND = (0, 1, 2), (3,)
CONVENTIONS = {
    "lerobot": _whole("observation.state", "action", list(JOINTS)),
    "lerobot 2.0": _whole("observation.state", "action", {"motors": list(JOINTS)}, version="v2.0"),
    "axes": _whole("observation.state", "action", {"axes": list(JOINTS)}),
    "places": _whole("observation.state", "action", {name: place for place, name in enumerate(JOINTS)}),
    "unitree": _whole("observation.state", "action", [list(JOINTS)]),
    "unnamed": _whole("observation.state", "action", None),
    "openpi": _whole("state", "actions", ["state"]),
    "openpi droid": Convention(
        {"joint_position": (["joint_position"], ARM), "gripper_position": (["gripper_position"], HAND)},
        {"actions": (["actions"], (*ARM, *HAND))},
    ),
    "agibot": Convention(
        {"observation.states.effector.position": (None, HAND), "observation.states.joint.position": (None, ARM)},
        {"actions.effector.position": (None, HAND), "actions.joint.position": (None, ARM)},
        others={
            "observation.states.end.position": 6,
            "observation.states.joint.velocity": 3,
            "observation.states.joint.current_value": 3,
            "observation.states.robot.orientation": 4,
            "actions.robot.velocity": 2,
        },
    ),
    "genie": Convention(
        {"states.left_joint.position": (None, ARM), "states.left_gripper.position": (None, HAND)},
        {"actions.left_joint.position": (None, ARM), "actions.left_gripper.position": (None, HAND)},
    ),
    "robot_state": _whole("robot_state", "action", None),
    "gr00t": _whole(
        "observation.state",
        "action",
        None,
        modality={
            "state": {"arm": {"start": 0, "end": 3}, "gripper": {"start": 3, "end": 4}},
            "action": {"arm": {"start": 0, "end": 3}, "gripper": {"start": 3, "end": 4}},
            "annotation": {"human.validity": {}, "human.task": {"original_key": "task_index"}},
        },
    ),
    "gr00t, other features": _whole(
        "robot.measured",
        "robot.wanted",
        None,
        modality={
            "state": {"arm": {"start": 0, "end": 4, "original_key": "robot.measured"}},
            "action": {"arm": {"start": 0, "end": 4, "original_key": "robot.wanted"}},
        },
    ),
}
"""Project -> its convention."""


def arm_motion(episode: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(T, 4) state and action of an arm and a gripper that follow their targets three frames late."""
    rng = np.random.default_rng(episode)
    frames = np.arange(LENGTH + LATE)[:, None]
    phases, rates = rng.uniform(0, 6, (2, len(JOINTS)))
    course = np.sin(frames / FPS * (1.5 + rates / 6) + phases)
    noise = rng.normal(0, 1e-3, (2, LENGTH, len(JOINTS)))
    return (course[:LENGTH] + noise[0]).astype(np.float32), (course[LATE:] + noise[1]).astype(np.float32)


def write_convention(root: Path, convention: Convention, *, frozen: bool = False) -> Path:
    """Write a dataset of four episodes; `frozen`: the elbow of episode 2 does not move from frame 30 on."""
    episodes = [arm_motion(number) for number in range(EPISODES)]
    if frozen:
        episodes[2][0][30:, 1] = episodes[2][0][30, 1]
    rng = np.random.default_rng(9)
    vectors: dict[str, tuple[Any, NDArray[np.float32]]] = {}
    for side, parts in enumerate((convention.state, convention.action)):
        values = np.concatenate([episode[side] for episode in episodes])
        vectors |= {name: (names, values[:, list(columns)]) for name, (names, columns) in parts.items()}
    for name, count in convention.others.items():
        vectors[name] = (None, rng.normal(size=(EPISODES * LENGTH, count)).astype(np.float32))
    features: dict[str, Any] = {
        name: {"dtype": "float32", "shape": [values.shape[1]], "names": names}
        for name, (names, values) in vectors.items()
    }
    features |= {name: {"dtype": kind, "shape": [1], "names": None} for name, kind in COUNTERS.items()}
    info = {"codebase_version": convention.version, "fps": FPS, "robot_type": "arm", "features": features}
    columns: dict[str, Any] = {
        name: pa.FixedSizeListArray.from_arrays(pa.array(values.reshape(-1)), values.shape[1])
        if values.shape[1] > 1
        else pa.array(values[:, 0])
        for name, (_, values) in vectors.items()
    }
    table = pa.table(columns | counters(LENGTH, EPISODES, FPS))
    write_tables(root, info, [table.slice(LENGTH * number, LENGTH) for number in range(EPISODES)], ["wave"])
    if convention.version == "v3.0":
        (root / "meta/stats.json").write_text("{}")
    if convention.modality is not None:
        (root / "meta/modality.json").write_text(json.dumps(convention.modality))
    return root

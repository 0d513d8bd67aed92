"""A recording in notebooks: its facts in one line or on a page, its numbers as a table."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from demorec.core.errors import MissingDependencyError
from demorec.core.text import printable
from demorec.episode.episode import Table, Trajectory
from demorec.episode.info import EpisodeInfo
from demorec.episode.simulated import simulation_facts
from demorec.mcap.episode_file import EpisodeFile

if TYPE_CHECKING:
    import pandas as pd

_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
_IMAGE_HEIGHT = 120
_OUTCOMES = {True: "success", None: "unknown"}


def line_of(recording: EpisodeFile) -> str:
    """Summarise a recording in one line, without control characters."""
    return printable(", ".join(f"{name} {value}" if name else value for name, value in _facts(recording)))


def page_of(recording: EpisodeFile, images: Mapping[str, Iterable[NDArray[np.uint8]]]) -> str:
    """Render the facts, and some images of cameras, as HTML."""
    facts = (("instruction", recording.info.instruction), *_facts(recording), ("file", str(recording.path)))
    rows = [(name or "length", html.escape(printable(value))) for name, value in facts]
    rows += [(camera, "".join(map(_image, shown))) for camera, shown in images.items()]
    cells = (
        f"<tr><th>{html.escape(printable(name))}</th><td style='text-align: left'>{cell}</td></tr>"
        for name, cell in rows
    )
    return f"<table>{''.join(cells)}</table>"


def _facts(recording: EpisodeFile) -> Iterator[tuple[str, str]]:
    info, outcome = recording.info, recording.outcome
    yield "", f"{recording.num_frames} frames ({recording.num_frames / info.fps:.1f} s at {info.fps} Hz)"
    task = simulation_facts(info).get("task", info.instruction)
    yield "task", f"{task} with {info.robot_name}"
    yield "episode", f"{info.episode_index}, attempt {info.attempt}"
    if outcome is None:
        yield "outcome", "unknown: recovered after a crash"
    else:
        phase = f" in phase {outcome.failure_phase}" if outcome.failure_phase else ""
        yield "outcome", _OUTCOMES.get(outcome.success) or f"{outcome.failure_reason}{phase}"
    yield "cameras", " and ".join(recording.cameras) or "none"


def _image(pixels: NDArray[np.uint8]) -> str:
    buffer = io.BytesIO()
    image = Image.fromarray(pixels)
    image.thumbnail((4 * _IMAGE_HEIGHT, _IMAGE_HEIGHT))
    image.save(buffer, format="JPEG", quality=85)
    data = base64.b64encode(buffer.getvalue()).decode()
    return f"<img style='display: inline' src='data:image/jpeg;base64,{data}'>"


def table_of(info: EpisodeInfo, numbers: Table | Trajectory) -> pd.DataFrame:
    """Build the table of `Recording.to_pandas`."""
    try:
        import pandas as pd
    except ImportError as error:
        raise MissingDependencyError("A table of the frames", "pandas", "pip install pandas") from error
    table: dict[str, Any] = {"time_ns": numbers.time_ns}
    if isinstance(numbers, Trajectory):
        table |= _trajectory_columns(info, numbers)
    else:
        for feature in info.features:
            table |= _components(feature.name, numbers.features[feature.name], feature.names)
    return pd.DataFrame(table, index=pd.RangeIndex(numbers.num_frames, name="frame_index"))


def _trajectory_columns(info: EpisodeInfo, trajectory: Trajectory) -> dict[str, Any]:
    table: dict[str, Any] = {"phase": trajectory.phase}
    robot = info.simulated.robot
    joints, arm = robot.joint_names, robot.arm_joints
    for name in ("joint_position", "joint_velocity", "joint_effort"):
        table |= _components(name, getattr(trajectory, name), joints)
    table |= {"gripper_width": trajectory.gripper_width, "contact_force": trajectory.contact_force}
    for name, values in trajectory.sensed.items():
        table |= _components(name, values, info.sensors[name].names)
    table |= _components("base_from_tcp", trajectory.base_from_tcp, _POSE)
    for kind in ("action", "command"):
        table |= _components(f"{kind}_joint_target", getattr(trajectory, f"{kind}_joint_target"), arm)
        table[f"{kind}_gripper"] = getattr(trajectory, f"{kind}_gripper")
        table |= _components(f"{kind}_base_from_tcp", getattr(trajectory, f"{kind}_base_from_tcp"), _POSE)
    for group in ("object_poses", "world_from_camera"):
        poses: Mapping[str, NDArray[np.float64]] = getattr(trajectory, group)
        for name, rows in poses.items():
            table |= _components(f"{group}.{name}", rows, _POSE)
    return {**table, "is_deliberate_miss": trajectory.is_deliberate_miss}


def _components(name: str, rows: NDArray[np.float64], parts: Sequence[str]) -> dict[str, NDArray[np.float64]]:
    """Split (T, D) rows into columns named by component."""
    return {f"{name}.{part}": rows[:, number] for number, part in enumerate(parts)}

"""What a person sees of a recording in a notebook: one line, a small page with pictures, a table of all numbers."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from demorec.core.errors import MissingDependencyError
from demorec.core.text import printable
from demorec.mcap.reader import RecordingReader

if TYPE_CHECKING:
    import pandas as pd

_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
_WRENCH = ("fx", "fy", "fz", "tx", "ty", "tz")
_MOMENTS, _PICTURE_HEIGHT = 5, 120


def described(recording: RecordingReader) -> str:
    """The facts about a recording in one line, without control characters."""
    return printable(", ".join(f"{name} {value}" if name else value for name, value in _facts(recording)))


def _facts(recording: RecordingReader) -> Iterator[tuple[str, str]]:
    info, outcome = recording.info, recording.outcome
    yield "", f"{recording.num_frames} frames ({recording.num_frames / info.fps:.1f} s at {info.fps} Hz)"
    yield "task", f"{info.task} with {info.robot.name}"
    yield "episode", f"{info.episode_index}, attempt {info.attempt}"
    if outcome is None:
        yield "outcome", "unknown: recovered after a crash"
    else:
        yield "outcome", "success" if outcome.success else f"{outcome.failure_reason} in phase {outcome.failure_phase}"
    yield "cameras", " and ".join(recording.cameras) or "none"


def html_page(recording: RecordingReader) -> str:
    """The facts, and pictures of every camera from the first to the last frame, as one piece of HTML."""
    facts = (("instruction", recording.info.instruction), *_facts(recording), ("file", str(recording.path)))
    rows = [
        f"<tr><th>{html.escape(printable(name or 'length'))}</th>"
        f"<td style='text-align: left'>{html.escape(printable(value))}</td></tr>"
        for name, value in facts
    ]
    moments = np.linspace(0, recording.num_frames - 1, _MOMENTS).round().astype(int).tolist()
    for camera in recording.cameras if recording.num_frames else ():
        pictures = "".join(_picture(recording.image(camera, moment)) for moment in moments)
        rows.append(f"<tr><th>{html.escape(printable(camera))}</th><td style='text-align: left'>{pictures}</td></tr>")
    return f"<table>{''.join(rows)}</table>"


def _picture(pixels: NDArray[np.uint8]) -> str:
    buffer = io.BytesIO()
    picture = Image.fromarray(pixels)
    picture.thumbnail((4 * _PICTURE_HEIGHT, _PICTURE_HEIGHT))
    picture.save(buffer, format="JPEG", quality=85)
    data = base64.b64encode(buffer.getvalue()).decode()
    return f"<img style='display: inline' src='data:image/jpeg;base64,{data}'>"


def frame_table(recording: RecordingReader) -> pd.DataFrame:
    """All numbers as a table, one row a frame, float64 to the bit; the index is `frame_index`.

    Columns are named as in `demorec.episode.episode.SimulatedColumns`, vectors with their component:
    `joint_position.panda_joint1` (rad, fingers m), `base_from_tcp.x` (m), `base_from_tcp.qw`,
    `wrench.fz` (N) and `wrench.tx` (N m) where they were recorded, `object_poses.red_cube.z` (m, world frame), `phase`.
    `time_ns` is simulated time since the episode's start.

    Raises:
        MissingDependencyError: pandas is not installed.
    """
    try:
        import pandas as pd
    except ImportError as error:
        raise MissingDependencyError("A table of the frames", "pandas", "pip install pandas") from error
    columns = recording.columns()
    table: dict[str, Any] = {"time_ns": columns.time_ns, "phase": columns.phase}
    joints, arm = recording.info.robot.joint_names, recording.info.robot.arm_joints
    for name in ("joint_position", "joint_velocity", "joint_effort"):
        table |= _components(name, getattr(columns, name), joints)
    table |= {"gripper_width": columns.gripper_width, "contact_force": columns.contact_force}
    if columns.wrench is not None:
        table |= _components("wrench", columns.wrench, _WRENCH)
    table |= _components("base_from_tcp", columns.base_from_tcp, _POSE)
    for kind in ("action", "command"):
        table |= _components(f"{kind}_joint_target", getattr(columns, f"{kind}_joint_target"), arm)
        table[f"{kind}_gripper"] = getattr(columns, f"{kind}_gripper")
        table |= _components(f"{kind}_base_from_tcp", getattr(columns, f"{kind}_base_from_tcp"), _POSE)
    for group in ("object_poses", "world_from_camera"):
        poses: Mapping[str, NDArray[np.float64]] = getattr(columns, group)
        for name, rows in poses.items():
            table |= _components(f"{group}.{name}", rows, _POSE)
    table["is_deliberate_miss"] = columns.is_deliberate_miss
    return pd.DataFrame(table, index=pd.RangeIndex(columns.num_frames, name="frame_index"))


def _components(name: str, rows: NDArray[np.float64], parts: Sequence[str]) -> dict[str, NDArray[np.float64]]:
    """The columns of (T, D) rows, named by their components."""
    return {f"{name}.{part}": rows[:, number] for number, part in enumerate(parts)}

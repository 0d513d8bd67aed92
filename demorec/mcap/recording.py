"""A recording as the sequence of its frames, at home in notebooks."""

from __future__ import annotations

import base64
import dataclasses
import html
import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from demorec.core.errors import MissingDependencyError, NotSimulatedError
from demorec.core.text import printable
from demorec.episode.episode import CameraImages, Columns, Event, Frame, JointSample
from demorec.episode.sensed import STREAMS
from demorec.mcap.reader import RecordingReader
from demorec.mcap.streams import action_at, observation_at, pose_of

if TYPE_CHECKING:
    import pandas as pd


class Recording(RecordingReader):
    """Context manager over one recording, and the sequence of its frames.

    `for frame in recording` gives numbers and images together, `recording[120]`, `recording[-1]` and
    `recording[::30]` any of them; `columns` gives all numbers at once, which is much faster where images are not
    needed. Frames are those of a simulation: asking another episode for them raises NotSimulatedError.
    """

    def __len__(self) -> int:
        return self.num_frames

    def __iter__(self) -> Iterator[Frame]:
        return _frames_with_images(self)

    @overload
    def __getitem__(self, index: int) -> Frame: ...

    @overload
    def __getitem__(self, index: slice) -> list[Frame]: ...

    def __getitem__(self, index: int | slice) -> Frame | list[Frame]:
        if isinstance(index, slice):
            return [self[number] for number in range(self.num_frames)[index]]
        columns, frames = self._numbers
        frame = frames[index]
        return dataclasses.replace(frame, images=_images_at(self, columns, frame.frame_index))

    @cached_property
    def _numbers(self) -> tuple[Columns, list[Frame]]:
        """All numbers, kept from the first frame on that is asked for."""
        columns = self.columns()
        return columns, list(frames_of(self, columns))

    def __repr__(self) -> str:
        return f"Recording({str(self.path)!r}: {_described(self)})"

    def _repr_html_(self) -> str:
        return _html_page(self)

    def to_pandas(self) -> pd.DataFrame:
        """All numbers as a table, one row a frame, bit-exact float64; the index is `frame_index`.

        Columns are named as in `demorec.episode.episode.Columns`, vectors with their component:
        `joint_position.panda_joint1` (rad, fingers m), `base_from_tcp.x` (m), `base_from_tcp.qw`,
        `wrench.fz` (N) and `wrench.tx` (N m) where they were recorded, `object_poses.red_cube.z` (m, world frame),
        `phase`. `time_ns` is simulated time since the episode's start. Of an external episode there are the stamps of
        its frames and its features: `observation.state.shoulder`.

        Raises:
            MissingDependencyError: pandas is not installed.
        """
        try:
            import pandas as pd
        except ImportError as error:
            raise MissingDependencyError("A table of the frames", "pandas", "pip install pandas") from error
        columns = self.columns()
        table: dict[str, Any] = {"time_ns": columns.time_ns}
        for feature in self.info.features:
            table |= _components(feature.name, columns.features[feature.name], feature.names)
        if self.info.simulation is not None:
            table |= self._simulated_table(columns)
        return pd.DataFrame(table, index=pd.RangeIndex(columns.num_frames, name="frame_index"))

    def _simulated_table(self, columns: Columns) -> dict[str, Any]:
        table: dict[str, Any] = {"phase": columns.phase}
        joints, arm = self.info.robot.joint_names, self.info.robot.arm_joints
        for name in ("joint_position", "joint_velocity", "joint_effort"):
            table |= _components(name, getattr(columns, name), joints)
        table |= {"gripper_width": columns.gripper_width, "contact_force": columns.contact_force}
        for name, values in columns.sensed.items():
            table |= _components(name, values, STREAMS[name][1].components(self.info.robot))
        table |= _components("base_from_tcp", columns.base_from_tcp, _POSE)
        for kind in ("action", "command"):
            table |= _components(f"{kind}_joint_target", getattr(columns, f"{kind}_joint_target"), arm)
            table[f"{kind}_gripper"] = getattr(columns, f"{kind}_gripper")
            table |= _components(f"{kind}_base_from_tcp", getattr(columns, f"{kind}_base_from_tcp"), _POSE)
        for group in ("object_poses", "world_from_camera"):
            poses: Mapping[str, NDArray[np.float64]] = getattr(columns, group)
            for name, rows in poses.items():
                table |= _components(f"{group}.{name}", rows, _POSE)
        return {**table, "is_deliberate_miss": columns.is_deliberate_miss}


def frames_of(recording: RecordingReader, columns: Columns | None = None) -> Iterator[Frame]:
    """Every frame without its images: numbers, phase, events, and the joint samples before it.

    Args:
        recording: An open recording.
        columns: Its columns, where the caller has read (or changed) them already.
    """
    columns = recording.columns() if columns is None else columns
    times = columns.time_ns.tolist()
    events: dict[int, list[Event]] = {}
    for time_ns, event in recording.events():
        frame = max(int(np.searchsorted(columns.time_ns, time_ns, side="right")) - 1, 0)
        events.setdefault(frame, []).append(event)
    samples = _samples_before_frames(recording, times)
    for index, time_ns in enumerate(times):
        yield Frame(
            frame_index=index,
            time_ns=time_ns,
            observation=observation_at(columns, index),
            action=action_at(columns, index, "action"),
            command=action_at(columns, index, "command"),
            phase=columns.phase[index],
            events=tuple(events.get(index, ())),
            joint_samples=samples.get(index, ()),
            is_deliberate_miss=bool(columns.is_deliberate_miss[index]),
        )


def _samples_before_frames(recording: RecordingReader, times: list[int]) -> dict[int, tuple[JointSample, ...]]:
    number = {time_ns: index for index, time_ns in enumerate(times)}
    result: dict[int, tuple[JointSample, ...]] = {}
    waiting: list[JointSample] = []
    for sample in recording.joint_samples():
        if sample.time_ns in number:
            if waiting:
                result[number[sample.time_ns]] = tuple(waiting)
            waiting = []
        else:
            waiting.append(sample)
    return result


def decoded_images(recording: RecordingReader, columns: Columns) -> Iterator[Mapping[str, CameraImages]]:
    """The recorded images of every frame, decoded (so not those that were encoded), with the recorded camera poses."""
    streams = {
        name: (
            recording.images(name),
            recording.depth(name) if recording.has_depth(name) else None,
            recording.segmentation(name) if recording.has_segmentation(name) else None,
        )
        for name in recording.cameras
    }
    for index in range(columns.num_frames):
        yield {
            name: CameraImages(
                color=next(color),
                depth=None if depth is None else next(depth),
                segmentation=None if labels is None else next(labels),
                world_from_camera=pose_of(columns.world_from_camera[name][index]),
            )
            for name, (color, depth, labels) in streams.items()
        }


def _frames_with_images(recording: RecordingReader) -> Iterator[Frame]:
    """Every frame with its decoded images, one after the other: a few images are in memory at a time."""
    columns = recording.columns()
    for frame, images in zip(frames_of(recording, columns), decoded_images(recording, columns), strict=True):
        yield replace(frame, images=images)


def _images_at(recording: RecordingReader, columns: Columns, frame: int) -> Mapping[str, CameraImages]:
    """The images of one frame; only those from the keyframe before it on are decoded."""

    def at[P](images: Callable[[str], Iterator[P]], camera: str) -> P:
        return next(islice(images(camera), frame, None))

    return {
        name: CameraImages(
            color=next(recording.images_at(name, [frame])),
            depth=at(recording.depth, name) if recording.has_depth(name) else None,
            segmentation=at(recording.segmentation, name) if recording.has_segmentation(name) else None,
            world_from_camera=pose_of(columns.world_from_camera[name][frame]),
        )
        for name in recording.cameras
    }


_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
_MOMENTS, _IMAGE_HEIGHT = 5, 120
_OUTCOMES = {True: "success", None: "unknown"}


def _described(recording: RecordingReader) -> str:
    """The facts about a recording in one line, without control characters."""
    return printable(", ".join(f"{name} {value}" if name else value for name, value in _facts(recording)))


def _facts(recording: RecordingReader) -> Iterator[tuple[str, str]]:
    info, outcome = recording.info, recording.outcome
    yield "", f"{recording.num_frames} frames ({recording.num_frames / info.fps:.1f} s at {info.fps} Hz)"
    task = info.instruction if info.simulation is None else info.task
    yield "task", f"{task} with {info.robot_name}"
    yield "episode", f"{info.episode_index}, attempt {info.attempt}"
    if outcome is None:
        yield "outcome", "unknown: recovered after a crash"
    else:
        phase = f" in phase {outcome.failure_phase}" if outcome.failure_phase else ""
        yield "outcome", _OUTCOMES.get(outcome.success) or f"{outcome.failure_reason}{phase}"
    yield "cameras", " and ".join(recording.cameras) or "none"


def _html_page(recording: RecordingReader) -> str:
    """The facts, and images of every camera from the first to the last frame, as one piece of HTML."""
    facts = (("instruction", recording.info.instruction), *_facts(recording), ("file", str(recording.path)))
    rows = [
        f"<tr><th>{html.escape(printable(name or 'length'))}</th>"
        f"<td style='text-align: left'>{html.escape(printable(value))}</td></tr>"
        for name, value in facts
    ]
    moments = np.linspace(0, recording.num_frames - 1, _MOMENTS).round().astype(int).tolist()
    for camera in (name for name in recording.cameras if recording.num_frames and recording.num_images(name)):
        images = "".join(map(_image, recording.images_at(camera, moments)))
        rows.append(f"<tr><th>{html.escape(printable(camera))}</th><td style='text-align: left'>{images}</td></tr>")
    return f"<table>{''.join(rows)}</table>"


def _image(pixels: NDArray[np.uint8]) -> str:
    buffer = io.BytesIO()
    image = Image.fromarray(pixels)
    image.thumbnail((4 * _IMAGE_HEIGHT, _IMAGE_HEIGHT))
    image.save(buffer, format="JPEG", quality=85)
    data = base64.b64encode(buffer.getvalue()).decode()
    return f"<img style='display: inline' src='data:image/jpeg;base64,{data}'>"


def _components(name: str, rows: NDArray[np.float64], parts: Sequence[str]) -> dict[str, NDArray[np.float64]]:
    """The columns of (T, D) rows, named by their components."""
    return {f"{name}.{part}": rows[:, number] for number, part in enumerate(parts)}


def open_recording(path: str | Path, *, simulated: bool = False) -> Recording:
    """Open a recording.

    Args:
        path: Of the file.
        simulated: Whether only an episode that demorec simulated will do.

    Raises:
        NotSimulatedError: It was recorded by another robot or program, and that will not do.
        RecordingError: As `Recording`.
    """
    recording = Recording(path)
    if simulated and recording.info.simulation is None:
        recording.close()
        raise NotSimulatedError("scene", recording.path)
    return recording

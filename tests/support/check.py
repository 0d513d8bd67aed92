"""Good recordings, runs and datasets, and ways to damage them one fault at a time.

Nothing here depends on the checks. Every function that damages something asserts that it did.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from demorec.check.base import Check, CheckResult
from demorec.check.report import CheckOptions, Subject, SubjectReport, check_subject
from demorec.core.config import EpisodePlan, GenerateConfig
from demorec.episode.episode import CameraImages, Event, Frame, Outcome, Trajectory
from demorec.episode.info import EpisodeInfo
from demorec.extensions.doctor.check_command import split_checks
from demorec.extensions.doctor.examine import examine
from demorec.extensions.doctor.from_dataset import ReadOptions
from demorec.loop import ScriptAgent, Session, SimulatorCache, prepare
from demorec.mcap import EpisodeWriter, Recording
from demorec.mcap.container import Container
from demorec.mcap.frames import frames_of
from demorec.mcap.part_file import PartFile
from demorec.mcap.writer import BatchWriter
from demorec.robots.motors import Motors
from demorec.runs.recorded import inspect_recording
from demorec.runs.run_file import GeneratedRun, save_run_file
from support.mcap import metadata_of

Images = list[dict[str, CameraImages]]


def simulate(path: Path, *, episode_index: int = 0, **config: Any) -> Path:
    config = {"cameras": (), "width": 96, "height": 96, **config}
    plan = EpisodePlan(config=GenerateConfig(**config), episode_index=episode_index)
    episode = prepare(plan)
    path.parent.mkdir(parents=True, exist_ok=True)
    with (
        SimulatorCache() as simulators,
        EpisodeWriter(path, episode.info, video=plan.config.video) as writer,
    ):
        world, renderer = simulators.acquire(episode.info)
        session = Session.of_episode(world, episode, renderer)
        for frame in session.run(ScriptAgent(episode)):
            writer.write(frame)
        writer.finish(session.outcome)
    return path


def simulate_run(folder: Path, num_episodes: int, **config: Any) -> Path:
    """Make a run folder with run.json, without worker processes."""
    config = {"cameras": (), "width": 96, "height": 96, **config}
    attempts = []
    for index in range(num_episodes):
        file = f"episodes/episode_{index:06d}.mcap"
        simulate(folder / file, episode_index=index, **config)
        attempts.append(replace(inspect_recording(folder / file)[0], file=file))
        assert attempts[-1].success
    (folder / "failed").mkdir(exist_ok=True)
    run = GeneratedRun(
        config=GenerateConfig(**config), versions={}, num_episodes=num_episodes, attempts=tuple(attempts)
    )
    save_run_file(run, folder)
    return folder


def checked(
    path: Path,
    kind: str = "recording",
    *,
    only: Sequence[str] = (),
    images: bool = True,
    motors: Motors | None = None,
) -> SubjectReport:
    """Run some checks, or all: of files' integrity, and of motion and images, in one form."""
    integrity, doctors = split_checks(only)
    subject = Subject(path=path, kind=kind)  # type: ignore[arg-type]
    found: tuple[CheckResult, ...] = ()
    if integrity or not only:
        found = check_subject(subject, CheckOptions(only=integrity, images=images)).results
    if doctors and (kind != "run" or only):
        found += tuple(_of_doctor(path, doctors, ReadOptions(images=images, motors=motors)))
    return SubjectReport(**vars(subject), results=found)


def _of_doctor(path: Path, checks: Sequence[Check], options: ReadOptions) -> Iterator[CheckResult]:
    """Convert the report of the dataset checks: one result of each check that applies."""
    diagnosis, _ = examine(path, options, checks=checks)
    for check in checks:
        found = tuple(finding for finding in diagnosis.findings if finding.check == check.name)
        yield CheckResult(check=check.name, findings=found, not_measured=diagnosis.not_measured.get(check.name, ""))


def result_of(path: Path, check: str, kind: str) -> CheckResult:
    """Return the result of one check, which must apply."""
    (result,) = checked(path, kind, only=[check]).results
    return result


def verdict_of(path: Path, check: str, kind: str = "recording") -> str:
    """Return the verdict of one check; "not applicable" if it has no result."""
    report = checked(path, kind, only=[check])
    return next((result.verdict for result in report.results if result.check == check), "not applicable")


class Spoilt:
    """A recording in memory that can be changed and written again.

    Attributes:
        info, columns, outcome: Parts of the recording; replace them or write into the arrays.
        images: Camera name -> images of every frame, decoded; empty without cameras.
        frames: Numbers of the frames to be written, in order.
        events: Frame -> events of that frame, in place of the recorded ones.
    """

    def __init__(self, path: Path) -> None:
        with Recording(path) as recording:
            self.info: EpisodeInfo = recording.info
            self.columns: Trajectory = recording.trajectory()
            self.outcome: Outcome | None = recording.outcome
            frames = list(recording)
            self.images: Images = [dict(frame.images) for frame in frames]
            self._frames = [replace(frame, images={}) for frame in frames]
            self.joint_samples = [frame.joint_samples for frame in self._frames]
        self._source = path
        self.events: dict[int, tuple[Event, ...]] = {}
        self.frames = list(range(len(self._frames)))

    def set(self, **arrays: Any) -> None:
        for name, array in arrays.items():
            before = getattr(self.columns, name)
            same = (
                all(np.array_equal(before[key], array[key], equal_nan=True) for key in before)
                if isinstance(before, dict)
                else np.array_equal(before, array, equal_nan=True)
            )
            assert not same, f"{name} was not changed"
        self.columns = replace(self.columns, **arrays)

    def pose_of(self, name: str, rows: Any) -> None:
        self.set(object_poses={**self.columns.object_poses, name: np.asarray(rows)})

    def image(self, camera: str, change: Callable[[int, np.ndarray[Any, Any]], Any]) -> None:
        """Replace a camera's colour images by what `change(frame, image)` returns."""
        changed = 0
        new = []
        for frame, images in enumerate(self.images):
            color = np.ascontiguousarray(change(frame, images[camera].color))
            changed += int(not np.array_equal(color, images[camera].color))
            new.append({**images, camera: replace(images[camera], color=color)})
        assert changed > 0, "no image was changed"
        self.images = new

    def write(self, path: Path) -> Path:
        with Recording(self._source) as recording:
            frames = list(frames_of(self.columns, recording.events(), recording.joint_samples()))
        outcome = self.outcome
        assert outcome is not None
        # As a program without checks would write it: demorec's own writer refuses some of the faults.
        with pytest.MonkeyPatch.context() as patch, EpisodeWriter(path, self.info) as writer:
            patch.setattr(BatchWriter, "_vector", lambda _, stream, parts: np.concatenate(parts))
            for number, index in enumerate(self.frames):
                writer.write(self._frame(frames[index], number, index))
            writer.finish(replace(outcome, num_frames=len(self.frames)))
        return path

    def _frame(self, frame: Frame, number: int, index: int) -> Frame:
        from demorec.episode.episode import frame_time_ns
        from demorec.mcap.frames import pose_of

        images = {
            name: replace(image, world_from_camera=pose_of(self.columns.world_from_camera[name][index]))
            for name, image in self.images[index].items()
        }
        return replace(
            frame, frame_index=number, time_ns=frame_time_ns(number, self.info.fps), images=images,
            joint_samples=self.joint_samples[index], events=self.events.get(index, frame.events),
        )  # fmt: skip


Message = tuple[str, str, bytes, int]
"""Topic, type, bytes, time in ns."""


def rewrite_messages(
    source: Path,
    target: Path,
    edit: Callable[[Message], Iterable[Message]],
    *,
    metadata: Callable[[str, dict[str, str]], dict[str, str] | None] = lambda name, values: values,
) -> Path:
    """Copy an MCAP file message by message; `edit` returns the replacement of each message."""
    container = Container(source)
    writer = PartFile(target)
    changed = 0
    for name, values in metadata_of(source).items():
        new = metadata(name, dict(values))
        changed += int(new != values)
        if new is not None:
            writer.metadata(name, new)
    schemas = {topic: container.schemas[c.schema_id].name for topic, c in container.channels.items()}
    for topic, time_ns, data in container.messages(list(schemas)):
        before = (topic, schemas[topic], data, time_ns)
        after = list(edit(before))
        changed += int(after != [before])
        for new_topic, schema, new_data, new_time in after:
            writer.log(new_topic, schema, new_data, new_time)
    writer.publish()
    container.close()
    assert changed > 0, "nothing was changed"
    return target


def flip_bits(source: Path, target: Path, *, offset: int) -> Path:
    """Copy a file with all bits of one byte inverted; a negative offset counts from the end."""
    data = bytearray(source.read_bytes())
    data[offset] ^= 0xFF
    assert bytes(data) != source.read_bytes()
    target.write_bytes(data)
    return target


def edit_parquet(path: Path, name: str, change: Callable[[list[Any]], list[Any]]) -> None:
    """Change one column of a table, all rows together; everything else stays."""
    table = pq.read_table(path)
    before = table.column(name).to_pylist()
    after = change(deepcopy(before))
    assert repr(after) != repr(before), f"{name} was not changed"
    field = table.schema.field(name)
    place = table.schema.get_field_index(name)
    pq.write_table(table.set_column(place, field, pa.array(after, type=field.type)), path)


def edit_column(dataset: Path, name: str, change: Callable[[np.ndarray[Any, Any]], Any]) -> None:
    """Change one column of the first data file as an array, all rows together."""

    def of_array(rows: list[Any]) -> list[Any]:
        values = np.array(rows)
        changed: list[Any] = np.asarray(change(values.copy())).astype(values.dtype).tolist()
        return changed

    edit_parquet(next((dataset / "data").glob("*/*.parquet")), name, of_array)


def change_table(dataset: Path, place: str, change: Callable[[pa.Table], pa.Table]) -> None:
    path = next(dataset.glob(f"{place}/*/*.parquet"))
    table = pq.read_table(path)
    changed = change(table)
    assert not changed.equals(table)
    pq.write_table(changed, path)


def edit_json(path: Path, change: Callable[[Any], object]) -> None:
    data = json.loads(path.read_text())
    before = json.dumps(data)
    change(data)
    assert json.dumps(data) != before
    path.write_text(json.dumps(data))

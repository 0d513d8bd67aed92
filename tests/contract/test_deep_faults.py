"""Faults of what only demorec's own episodes have: each is found when the episode is made again (`check --deep`).

What is said twice, phases, retries, drawn numbers, config and robot have no check of their own.
"""

from __future__ import annotations

import math
import shutil
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.check import Message, Spoilt, level_of, rewrite_messages, simulate
from support.faults import Changed, Fault, Rows, both_grippers, condition, info, late, outcome
from support.mcap import sealed
from support.params import every_other_long

from demorec.core.geometry import Pose
from demorec.episode.camera_error import error_values
from demorec.episode.episode import Event, SuccessCheck
from demorec.mcap import Recording, channels, messages
from demorec.mcap.streams import frame_streams
from demorec.replay.deep import deep_check
from demorec.robots.panda import PANDA

pytestmark = pytest.mark.slow

Edit = Callable[[Message], list[Message]]
INFO = channels.camera_topic("front", "camera_info")
VIDEO, H264 = channels.camera_topic("front", "video"), channels.camera_topic("front", "h264")
DEPTH, LABELED = channels.camera_topic("front", "depth"), channels.camera_topic("front", "segmentation")
SECOND = 1_000_000_000


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One short pick-and-place with small images of all kinds."""
    path = tmp_path_factory.mktemp("good") / "good.mcap"
    return simulate(path, seed=7, cameras=("front",), width=32, height=32, fps=10, depth=True, segmentation=True)


@pytest.fixture(scope="module")
def blind(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same without images, at 30 frames a second."""
    return simulate(tmp_path_factory.mktemp("blind") / "good.mcap", seed=7)


def bytes_for(topic: str, old: bytes, new: bytes, *, at: int | None = None) -> Edit:
    """Other bytes in the messages of a topic, or in the one at a time."""

    def edit(m: Message) -> list[Message]:
        chosen = m[0] == topic and (at is None or m[3] == at)
        return [(m[0], m[1], m[2].replace(old, new), m[3])] if chosen else [m]

    return edit


def floats_for(topic: str, change: Callable[[Rows], None], *, at: int | None = None) -> Edit:
    """Other float64 at the end of the messages of a topic, given as one array that is changed in place."""

    def edit(m: Message) -> list[Message]:
        if m[0] != topic or (at is not None and m[3] != at):
            return [m]
        data = bytearray(m[2])
        start = len(data) - 7 * 8
        values = np.frombuffer(bytes(data[start:]), dtype="<f8").copy()
        change(values)
        data[start:] = values.tobytes()
        return [(m[0], m[1], bytes(data), m[3])]

    return edit


def entry(index: int, factor: float = 1.0, plus: float = 0.0) -> Callable[[Rows], None]:
    def change(values: Rows) -> None:
        values[index] = values[index] * factor + plus

    return change


def calibration(offset: int, value: float) -> Edit:
    """Another float64 of camera_info, so many places after the start of K."""

    def edit(m: Message) -> list[Message]:
        if m[0] != INFO:
            return [m]
        _, k = messages.read_camera_info(m[2])
        start = m[2].index(struct.pack("<d", k[0, 0])) + 8 * offset
        return [(m[0], m[1], m[2][:start] + struct.pack("<d", value) + m[2][start + 8 :], m[3])]

    return edit


def message_before(topic: str) -> Edit:
    """At two seconds the image of the frame before once more, with the time of its own."""
    kept: list[bytes] = []

    def edit(m: Message) -> list[Message]:
        if m[0] != topic:
            return [m]
        kept.append(m[2])
        if m[3] != 2 * SECOND:
            return [m]
        before = kept[-2]
        return [(m[0], m[1], before[:4] + m[2][4:12] + before[12:], m[3])]

    return edit


def without(topic: str, *, at: int | None = None) -> Edit:
    return lambda m: [] if m[0] == topic and (at is None or m[3] == at) else [m]


def stamped(topic: str, second: int, *, at: int | None = None) -> Edit:
    """Another time in the first stamp of a message that begins with a number of elements."""

    def edit(m: Message) -> list[Message]:
        chosen = m[0] == topic and m[3] >= SECOND and at in (None, m[3])
        return [(m[0], m[1], m[2][:8] + struct.pack("<iI", second, 0) + m[2][16:], m[3])] if chosen else [m]

    return edit


def event_at(change: Callable[[Event], list[Event]]) -> Edit:
    """Other events of the changes of phase."""

    def edit(m: Message) -> list[Message]:
        if m[0] != channels.EVENTS or (event := messages.read_log(m[2])).name != channels.PHASE_EVENT:
            return [m]
        return [(m[0], m[1], messages.log(m[3], new), m[3]) for new in change(event)]

    return edit


MESSAGES: list[tuple[str, Edit]] = [
    ("an object's frame turned", floats_for(channels.TF, entry(3, plus=0.3))),
    ("an object's frame a millimetre off", floats_for(channels.TF, entry(0, plus=1e-3))),
    ("an object's frame off once", floats_for(channels.TF, entry(2, plus=0.01), at=2 * SECOND)),
    ("an object's frame in millimetres", floats_for(channels.TF, entry(0, factor=1000))),
    ("an object's frame mirrored", floats_for(channels.TF, entry(1, factor=-1))),
    ("frames of the frame before", message_before(channels.TF)),
    ("another name of a frame", bytes_for(channels.TF, b"panda_link4", b"panda_link9")),
    ("a frame at another parent", bytes_for(channels.TF, b"world\x00", b"wurld\x00")),
    ("stamps of the start", stamped(channels.TF, 0)),
    ("one stamp of the start", stamped(channels.TF, 0, at=2 * SECOND)),
    ("no frames at one moment", without(channels.TF, at=2 * SECOND)),
    ("a standing frame off", floats_for(channels.TF_STATIC, entry(0, plus=0.01))),
    ("a standing frame of another name", bytes_for(channels.TF_STATIC, b"camera_front", b"camera_fr0nt")),
    ("no standing frames", without(channels.TF_STATIC)),
    ("another principal point", calibration(2, 3.0)),
    ("K of another focal length", calibration(0, 99.0)),
    ("a turned R", calibration(9, -1.0)),
    ("P of a stereo camera", calibration(9 + 9 + 3, -12.0)),
    ("P of another focal length", calibration(9 + 9, 70.0)),
    ("calibration of another camera", bytes_for(INFO, b"camera_front", b"camera_wrist")),
    ("distortion that is none", calibration(-1, 0.2)),
    ("another model of distortion", bytes_for(INFO, b"plumb_bob", b"rationalx")),
    ("calibration twice", lambda m: [m, m] if m[0] == INFO else [m]),
    ("labels with other names", bytes_for(channels.LABELS, b"red_cube", b"blu_cube")),
    ("labels with two names exchanged",
     lambda m: [(m[0], m[1], m[2].replace(b"panda_link1\x00", b"#").replace(b"panda_link2\x00", b"panda_link1\x00")
                 .replace(b"#", b"panda_link2\x00"), m[3])] if m[0] == channels.LABELS else [m]),
    ("no names of labels", without(channels.LABELS)),
    ("a robot of other colours", bytes_for("/robot_description", b"rgba=\"1", b"rgba=\"0")),
    ("a larger cube in its description",
     bytes_for("/object/red_cube/robot_description", b"<box", b"<bax")),
    ("/video with the image before", message_before(VIDEO)),
    ("/video with one image less", without(VIDEO, at=2 * SECOND)),
    ("/h264 with the image before", message_before(H264)),
    ("/video of another camera", bytes_for(VIDEO, b"camera_front", b"camera_wrist")),
    ("/video of another format", bytes_for(VIDEO, b"\5\0\0\0h264", b"\5\0\0\0h265")),
    ("/h264 of another format at one moment",
     bytes_for(H264, b"h264\x00", b"h265\x00", at=2 * SECOND)),
    ("depth of another camera", bytes_for(DEPTH, b"camera_front", b"camera_wrist")),
    ("labels of another camera", bytes_for(LABELED, b"camera_front", b"camera_wrist")),
    ("depth of another format", bytes_for(DEPTH, b"16UC1", b"32FC1")),
    ("an event of a phase less", event_at(lambda e: [] if e.message == "lift" else [e])),
    ("an event of a phase twice", event_at(lambda e: [e, Event(name="phase", message="again")])),
    ("an event of another phase", event_at(lambda e: [Event(name="phase", message=e.message[::-1])])),
    ("events of phases as warnings",
     event_at(lambda e: [Event(name=e.name, message=e.message, level="warning")])),
    ("a phase less", lambda m: [] if m[0] == channels.PHASE and b"lift" in m[2] else [m]),
]  # fmt: skip


def phases(change: Callable[[list[str]], list[str]]) -> Fault:
    return lambda c: c.with_columns(phase=tuple(change(list(c.columns.phase))))


def config(**fields: Any) -> Fault:
    return lambda c: c.with_info(config={**c.info.config, **fields})


def robot(**fields: Any) -> Fault:
    return lambda c: c.with_info(robot=replace(c.info.robot, **fields))


def behaviour(**values: float) -> Fault:
    return lambda c: c.with_info(behaviour={**c.info.behaviour, **values})


def without_phase(name: str, instead: str) -> Callable[[list[str]], list[str]]:
    return lambda rows: [instead if phase == name else phase for phase in rows]


def exchanged(a: str, b: str) -> Callable[[list[str]], list[str]]:
    return lambda rows: [{a: b, b: a}.get(phase, phase) for phase in rows]


def missed(frames: slice) -> Fault:
    def fault(c: Changed) -> Changed:
        flags = c.columns.is_deliberate_miss.copy()
        flags[frames] = True
        return c.with_columns(is_deliberate_miss=flags)

    return fault


def scene(change: Callable[[Any], Any]) -> Fault:
    return lambda c: c.with_info(scene=change(c.info.scene))


DESCRIBED: list[tuple[str, Fault]] = [
    ("gripper late in both", both_grippers(late)),
    ("noise doubled", lambda c: c.with_columns(
        command_joint_target=2 * c.columns.command_joint_target - c.columns.action_joint_target)),
    ("labels in place of commands", lambda c: c.with_columns(
        action_joint_target=c.columns.command_joint_target)),
    ("noise where none is said", behaviour(action_noise=0.0)),
    ("a tenth of the noise is said", behaviour(action_noise=0.002)),
    ("a speed that is not drawn", behaviour(speed=1.3)),
    ("a height that is not drawn", behaviour(approach_height=0.05)),
    ("a miss that is not drawn", behaviour(miss_x=0.04)),
    ("perception that errs", behaviour(perception_yaw=0.1)),
    ("more noise than is drawn", behaviour(action_noise=0.03)),
    ("a calibration error that is not drawn", behaviour(**error_values({"front": Pose(
        position=np.array([0.0, 0.05, 0.0]))}))),
    ("a calibration turn that is not drawn", behaviour(**error_values({"front": Pose(
        quat_xyzw=np.array([0.0, 0.1, 0.0, math.sqrt(0.99)]))}))),
    ("phases one frame late", phases(lambda rows: [rows[0], *rows[:-1]])),
    ("phases one frame early", phases(lambda rows: [*rows[1:], rows[-1]])),
    ("phases backwards", phases(lambda rows: rows[::-1])),
    ("all one phase", phases(lambda rows: ["approach"] * len(rows))),
    ("phases frozen", phases(lambda rows: rows[:100] + [rows[100]] * (len(rows) - 100))),
    ("one alien phase", phases(lambda rows: [*rows[:20], "lift", *rows[21:]])),
    ("lift for lower", phases(exchanged("lift", "lower"))),
    ("close for release", phases(exchanged("close", "release"))),
    ("no lift", phases(without_phase("lift", "transport"))),
    ("no descent", phases(without_phase("descend", "approach"))),
    ("an unknown phase", phases(without_phase("lower", "place"))),
    ("retreat for release", phases(exchanged("retreat", "release"))),
    ("no phases before the descent", phases(lambda rows: ["descend" if p == "approach" else p for p in rows])),
    ("a retry that was none", outcome(num_retries=1)),
    ("misses where there are none", missed(slice(0, 60))),
    ("a miss in the midst", missed(slice(90, 110))),
    ("a tilt that is not seen", condition("tilt", value=0.08)),
    ("an opening that is not seen", condition("gripper_width", value=0.2)),
    ("another task", info(task="stack")),
    ("another seed", info(root_seed=8)),
    ("another rate", info(fps=60)),
    ("another physics rate", info(physics_hz=480)),
    ("an attempt that is not allowed", info(attempt=7)),
    ("a config of another seed", config(seed=8)),
    ("a config of another speed limit", config(max_episode_seconds=61.0)),
    ("another digest of the config", info(config_digest="0" * 16)),
    ("physics of another rate", scene(lambda s: replace(s, physics=replace(s.physics, hz=120)))),
    ("a scene with another robot", scene(lambda s: replace(s, robot=replace(s.robot, name="iiwa")))),
    ("a robot of another name", robot(name="iiwa")),
    ("a stronger gripper", robot(gripper=replace(PANDA.gripper, force=40.0))),
    ("a faster robot", robot(velocity_limit=(99.0,) * 7)),
    ("wider limits", robot(position_upper=(9.0,) * 7)),
    ("another hand", robot(hand_link="panda_link7")),
    ("a robot of another scale", scene(lambda s: replace(s, robot=replace(s.robot, scale=1.3)))),
    ("passed beyond the limit", condition("tilt", value=1.0)),
    ("an open gripper that was closed", condition("gripper_width", value=0.01)),
    ("another limit", condition("distance_to_goal", limit=1e-9)),
    ("a success that leaves the cube behind", lambda c: c.with_outcome(checks=(SuccessCheck(
        name="x", value=2, limit=1, unit="", passed=True), *c.outcome.checks))),
]  # fmt: skip


Judge = Callable[[Path, Path], str]


@pytest.fixture
def judge(monkeypatch: pytest.MonkeyPatch) -> Judge:
    """What `check --deep` says of a spoilt recording that, made again, is the good one."""

    def level(good: Path, spoilt: Path) -> str:
        monkeypatch.setattr("demorec.replay.deep.check.remake", lambda recording, path, *_: shutil.copy(good, path))
        return deep_check(spoilt).level

    return level


def test_the_good_ones_come_out_the_same(good: Path, blind: Path, tmp_path: Path, judge: Judge) -> None:
    assert deep_check(good).level == "pass"
    assert deep_check(blind).level == "pass"
    assert judge(blind, Spoilt(blind).write(tmp_path / "again.mcap")) == "pass"


@pytest.mark.parametrize(("name", "edit"), every_other_long(MESSAGES))
def test_a_fault_of_messages(name: str, edit: Edit, good: Path, tmp_path: Path, judge: Judge) -> None:
    assert judge(good, rewrite_messages(good, tmp_path / "spoilt.mcap", edit)) == "fail"


@pytest.mark.parametrize(("name", "fault"), every_other_long(DESCRIBED))
def test_a_fault_of_what_is_described(name: str, fault: Fault, blind: Path, tmp_path: Path, judge: Judge) -> None:
    spoilt = Spoilt(blind)
    assert spoilt.outcome is not None
    changed = fault(Changed(columns=spoilt.columns, info=spoilt.info, outcome=spoilt.outcome))
    spoilt.columns, spoilt.info, spoilt.outcome = changed.columns, changed.info, changed.outcome
    assert judge(blind, spoilt.write(tmp_path / "spoilt.mcap")) == "fail"


def test_joint_states_off_the_physics_clock(tmp_path: Path, judge: Judge) -> None:
    good = simulate(tmp_path / "good.mcap", seed=7, fps=10, joint_rate="physics")
    times: list[int] = []

    def edit(m: Message) -> list[Message]:
        times.extend([m[3]] if m[0] == channels.JOINT_STATES else [])
        return [] if m[0] == channels.JOINT_STATES and len(times) == 100 else [m]

    spoilt = rewrite_messages(good, tmp_path / "spoilt.mcap", edit)
    assert judge(good, spoilt) == "fail"


@pytest.mark.parametrize(("topic", "slot"), [(channels.GRIPPER, 1), (channels.ACTION, 9), (channels.COMMAND, 23)])
@pytest.mark.parametrize("at", [None, 2 * SECOND])
def test_values_that_become_no_column(
    topic: str, slot: int, at: int | None, good: Path, tmp_path: Path, judge: Judge
) -> None:
    with Recording(good) as recording:
        layout = next(stream.layout for stream in frame_streams(recording.info) if stream.topic == topic)

    def edit(m: Message) -> list[Message]:
        if m[0] != topic or at not in (None, m[3]):
            return [m]
        values = layout.decode([m[2]])
        values[0, slot] += 0.01
        return [(m[0], m[1], layout.encode(np.array([m[3]]), values)[0], m[3])]

    assert judge(good, rewrite_messages(good, tmp_path / "s.mcap", edit)) == "fail"


@pytest.mark.parametrize(
    ("record", "key", "value"),
    [
        ("demorec.episode", "task", "stack"),
        ("demorec.episode", "instruction", "do it"),
        ("demorec.episode", "episode_index", "5"),
        ("demorec.episode", "attempt", "1"),
        ("demorec.episode", "root_seed", "8"),
        ("demorec.outcome", "success", "false"),
    ],
)
def test_a_summary_of_something_else(
    record: str, key: str, value: str, good: Path, tmp_path: Path, judge: Judge
) -> None:
    def metadata(name: str, values: dict[str, str]) -> dict[str, str]:
        return sealed({**values, key: value}) if name == record else values

    spoilt = rewrite_messages(good, tmp_path / "s.mcap", lambda m: [m], metadata=metadata)
    assert judge(good, spoilt) == "fail"


IMAGES: list[tuple[str, Edit, str]] = [
    ("a depth image that is cut off",
     lambda m: [(m[0], m[1], m[2][:-40], m[3])] if (m[0], m[3]) == (DEPTH, 2 * SECOND) else [m], "images_decode"),
    ("an image of labels that is none", bytes_for(LABELED, b"IHDR", b"IHOR", at=2 * SECOND), "images_decode"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "edit", "check"), IMAGES, ids=[name for name, *_ in IMAGES])
def test_a_fault_of_images_has_a_check(name: str, edit: Edit, check: str, good: Path, tmp_path: Path) -> None:
    assert level_of(good, check) == "pass"
    assert level_of(rewrite_messages(good, tmp_path / "spoilt.mcap", edit), check) == "fail"

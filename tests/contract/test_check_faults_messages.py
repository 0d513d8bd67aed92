"""Faults of messages and metadata, each caught by the check that makes the same again from what else is recorded."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.check import Message, level_of, rewrite_messages, simulate
from support.faults import Rows
from support.mcap import sealed

from demorec.episode.episode import Event
from demorec.mcap import channels, messages
from demorec.mcap.pictures import pixel_statistics, read_pixel_statistics

Edit = Callable[[Message], list[Message]]
INFO = channels.camera_topic("front", "camera_info")
VIDEO, H264 = channels.camera_topic("front", "video"), channels.camera_topic("front", "h264")
DEPTH, LABELED = channels.camera_topic("front", "depth"), channels.camera_topic("front", "segmentation")
SECOND = 1_000_000_000


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One short pick-and-place with small pictures of all kinds."""
    path = tmp_path_factory.mktemp("good") / "good.mcap"
    return simulate(path, seed=7, cameras=("front",), width=32, height=32, depth=True, segmentation=True)


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
        k = messages.read_camera_info(m[2]).intrinsics
        start = m[2].index(struct.pack("<d", k[0, 0])) + 8 * offset
        return [(m[0], m[1], m[2][:start] + struct.pack("<d", value) + m[2][start + 8 :], m[3])]

    return edit


def message_before(topic: str) -> Edit:
    """At two seconds the picture of the frame before once more, with the time of its own."""
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


def counted_twice(m: Message) -> list[Message]:
    """The histogram of twice as many pictures."""
    if m[0] != channels.camera_topic("front", "histogram"):
        return [m]
    told = read_pixel_statistics(m[2])
    return [(m[0], m[1], pixel_statistics(replace(told, num_images=2 * told.num_images)), m[3])]


def event_at(change: Callable[[Event], list[Event]]) -> Edit:
    """Other events of the changes of phase."""

    def edit(m: Message) -> list[Message]:
        if m[0] != channels.EVENTS or (event := messages.read_log(m[2])).name != channels.PHASE_EVENT:
            return [m]
        return [(m[0], m[1], messages.log(m[3], new), m[3]) for new in change(event)]

    return edit


CASES: list[tuple[str, Edit, str]] = [
    ("an object's frame turned", floats_for(channels.TF, entry(3, plus=0.3)), "moving_frames"),
    ("an object's frame a millimetre off", floats_for(channels.TF, entry(0, plus=1e-3)), "moving_frames"),
    ("an object's frame off once", floats_for(channels.TF, entry(2, plus=0.01), at=2 * SECOND), "moving_frames"),
    ("an object's frame in millimetres", floats_for(channels.TF, entry(0, factor=1000)), "moving_frames"),
    ("an object's frame mirrored", floats_for(channels.TF, entry(1, factor=-1)), "moving_frames"),
    ("frames of the frame before", message_before(channels.TF), "moving_frames"),
    ("another name of a frame", bytes_for(channels.TF, b"panda_link4", b"panda_link9"), "moving_frames"),
    ("a frame at another parent", bytes_for(channels.TF, b"world\x00", b"wurld\x00"), "moving_frames"),
    ("stamps of the start", stamped(channels.TF, 0), "moving_frames"),
    ("one stamp of the start", stamped(channels.TF, 0, at=2 * SECOND), "moving_frames"),
    ("no frames at one moment", without(channels.TF, at=2 * SECOND), "moving_frames"),
    ("a standing frame off", floats_for(channels.TF_STATIC, entry(0, plus=0.01)), "latched_messages"),
    ("a standing frame of another name", bytes_for(channels.TF_STATIC, b"camera_front", b"camera_fr0nt"),
     "latched_messages"),
    ("no standing frames", without(channels.TF_STATIC), "latched_messages"),
    ("another principal point", calibration(2, 3.0), "latched_messages"),
    ("K of another focal length", calibration(0, 99.0), "latched_messages"),
    ("a turned R", calibration(9, -1.0), "latched_messages"),
    ("P of a stereo camera", calibration(9 + 9 + 3, -12.0), "latched_messages"),
    ("P of another focal length", calibration(9 + 9, 70.0), "latched_messages"),
    ("distortion that is none", calibration(-1, 0.2), "latched_messages"),
    ("calibration of another camera", bytes_for(INFO, b"camera_front", b"camera_wrist"), "latched_messages"),
    ("another model of distortion", bytes_for(INFO, b"plumb_bob", b"rationalx"), "latched_messages"),
    ("calibration twice", lambda m: [m, m] if m[0] == INFO else [m], "latched_messages"),
    ("labels with other names", bytes_for(channels.LABELS, b"red_cube", b"blu_cube"), "latched_messages"),
    ("labels with two names exchanged",
     lambda m: [(m[0], m[1], m[2].replace(b"panda_link1\x00", b"#").replace(b"panda_link2\x00", b"panda_link1\x00")
                 .replace(b"#", b"panda_link2\x00"), m[3])] if m[0] == channels.LABELS else [m], "latched_messages"),
    ("no names of labels", without(channels.LABELS), "latched_messages"),
    ("a robot of other colours", bytes_for("/robot_description", b"rgba=\"1", b"rgba=\"0"), "latched_messages"),
    ("a larger cube in its description",
     bytes_for("/object/red_cube/robot_description", b"<box", b"<bax"), "latched_messages"),
    ("/video with the picture before", message_before(VIDEO), "picture_messages"),
    ("/video with one picture less", without(VIDEO, at=2 * SECOND), "picture_messages"),
    ("/h264 with the picture before", message_before(H264), "picture_messages"),
    ("/video of another camera", bytes_for(VIDEO, b"camera_front", b"camera_wrist"), "picture_messages"),
    ("/video of another format", bytes_for(VIDEO, b"\5\0\0\0h264", b"\5\0\0\0h265"), "picture_messages"),
    ("/h264 of another format at one moment",
     bytes_for(H264, b"h264\x00", b"h265\x00", at=2 * SECOND), "picture_messages"),
    ("depth of another camera", bytes_for(DEPTH, b"camera_front", b"camera_wrist"), "picture_messages"),
    ("labels of another camera", bytes_for(LABELED, b"camera_front", b"camera_wrist"), "picture_messages"),
    ("depth of another format", bytes_for(DEPTH, b"16UC1", b"32FC1"), "picture_messages"),
    ("a depth picture that is cut off",
     lambda m: [(m[0], m[1], m[2][:-40], m[3])] if (m[0], m[3]) == (DEPTH, 2 * SECOND) else [m], "pictures_decode"),
    ("a picture of labels that is none", bytes_for(LABELED, b"IHDR", b"IHOR", at=2 * SECOND), "pictures_decode"),
    ("a histogram of more pictures", counted_twice, "pixel_statistics"),
    ("an event of a phase less", event_at(lambda e: [] if e.message == "lift" else [e]), "phase_events"),
    ("an event of a phase twice", event_at(lambda e: [e, Event(name="phase", message="again")]), "phase_events"),
    ("an event of another phase", event_at(lambda e: [Event(name="phase", message=e.message[::-1])]), "phase_events"),
    ("events of phases as warnings",
     event_at(lambda e: [Event(name=e.name, message=e.message, level="warning")]), "phase_events"),
    ("a phase less", lambda m: [] if m[0] == channels.PHASE and b"lift" in m[2] else [m], "phase_events"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "edit", "check"), CASES, ids=[name for name, *_ in CASES])
def test_a_fault(name: str, edit: Edit, check: str, good: Path, tmp_path: Path) -> None:
    assert level_of(rewrite_messages(good, tmp_path / "spoilt.mcap", edit), check) == "fail"


def test_the_good_one_passes(good: Path) -> None:
    for check in sorted({check for *_, check in CASES} | {"derived_values", "metadata_agrees"}):
        assert level_of(good, check) == "pass", check


@pytest.mark.parametrize(("topic", "slot"), [(channels.GRIPPER, 1), (channels.ACTION, 9), (channels.COMMAND, 23)])
@pytest.mark.parametrize("at", [None, 2 * SECOND])
def test_values_that_become_no_column(topic: str, slot: int, at: int | None, good: Path, tmp_path: Path) -> None:
    from demorec.mcap import SimulatedRecording
    from demorec.mcap.streams import frame_streams

    with SimulatedRecording(good) as recording:
        layout = next(stream.layout for stream in frame_streams(recording.info) if stream.topic == topic)

    def edit(m: Message) -> list[Message]:
        if m[0] != topic or at not in (None, m[3]):
            return [m]
        values = layout.decode([m[2]])
        values[0, slot] += 0.01
        return [(m[0], m[1], layout.encode(np.array([m[3]]), values)[0], m[3])]

    assert level_of(rewrite_messages(good, tmp_path / "s.mcap", edit), "derived_values") == "fail"


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
def test_a_summary_of_something_else(record: str, key: str, value: str, good: Path, tmp_path: Path) -> None:
    def metadata(name: str, values: dict[str, str]) -> dict[str, str]:
        return sealed({**values, key: value}) if name == record else values

    spoilt = rewrite_messages(good, tmp_path / "s.mcap", lambda m: [m], metadata=metadata)
    assert level_of(spoilt, "metadata_agrees") == "fail"

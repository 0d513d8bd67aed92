"""What is written is what is read, to the bit."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.present import present
from support.recording import frame_number, make_episode, write_episode

from demorec.core.config import VideoConfig
from demorec.core.errors import RecordingError
from demorec.episode.episode import FORMAT_VERSION, Event, Frame, Outcome, SimulatedInfo
from demorec.mcap import SimulatedRecording, SimulatedWriter
from demorec.mcap.container import Container

CODECS = [VideoConfig(), VideoConfig(codec="av1"), VideoConfig(codec="jpeg"), VideoConfig(gop=30, crf=30)]


def record(
    path: Path, frames: list[Frame], info: SimulatedInfo, outcome: Outcome, video: VideoConfig | None = None
) -> Path:
    with SimulatedWriter(path, info, video=video) as writer:
        for frame in frames:
            writer.write(frame)
        writer.finish(outcome)
    return path


@pytest.mark.parametrize("num_frames", [1, 29, 30, 31, 75])
@pytest.mark.parametrize("cameras", [(), ("front", "wrist")])
def test_columns_are_the_frames_to_the_bit(tmp_path: Path, num_frames: int, cameras: tuple[str, ...]) -> None:
    info, frames, outcome = make_episode(num_frames=num_frames, cameras=cameras)
    path = record(tmp_path / "a.mcap", frames, info, outcome)
    with SimulatedRecording(path) as recording:
        assert recording.info == info
        assert recording.outcome == outcome
        assert recording.num_frames == num_frames
        columns = recording.columns()
    observations = [frame.observation for frame in frames]
    expected = {
        "time_ns": [frame.time_ns for frame in frames],
        "joint_position": [o.joint_position for o in observations],
        "joint_velocity": [o.joint_velocity for o in observations],
        "joint_effort": [o.joint_effort for o in observations],
        "gripper_width": [o.gripper_width for o in observations],
        "base_from_tcp": [o.base_from_tcp.vector() for o in observations],
        "contact_force": [o.contact_force for o in observations],
        "action_joint_target": [frame.action.joint_target for frame in frames],
        "action_gripper": [frame.action.gripper_target for frame in frames],
        "action_base_from_tcp": [frame.action.base_from_tcp_target.vector() for frame in frames],
        "command_joint_target": [frame.command.joint_target for frame in frames],
        "command_gripper": [frame.command.gripper_target for frame in frames],
        "command_base_from_tcp": [frame.command.base_from_tcp_target.vector() for frame in frames],
        "is_deliberate_miss": [frame.is_deliberate_miss for frame in frames],
    }
    for name, values in expected.items():
        found = getattr(columns, name)
        assert found.tobytes() == np.array(values, dtype=found.dtype).tobytes(), name
    assert np.array_equal(columns.sensed["wrench"], [o.sensed["wrench"] for o in observations])
    assert columns.phase == tuple(frame.phase for frame in frames)
    assert list(columns.object_poses) == ["cube"]
    assert np.array_equal(columns.object_poses["cube"], [o.object_poses["cube"].vector() for o in observations])
    assert list(columns.world_from_camera) == list(cameras)
    for name in cameras:
        poses = [frame.images[name].world_from_camera.vector() for frame in frames]
        assert np.array_equal(columns.world_from_camera[name], poses)


def test_actions_and_commands_are_kept_apart(tmp_path: Path) -> None:
    with SimulatedRecording(write_episode(tmp_path / "a.mcap", num_frames=5, cameras=())) as recording:
        columns = recording.columns()
    assert not np.array_equal(columns.action_joint_target, columns.command_joint_target)


@pytest.mark.parametrize("video", CODECS, ids=lambda video: f"{video.codec}-{video.gop}")
def test_pictures(tmp_path: Path, video: VideoConfig) -> None:
    info, frames, outcome = make_episode(num_frames=64)
    path = record(tmp_path / "a.mcap", frames, info, outcome, video)
    with SimulatedRecording(path) as recording:
        for camera in recording.cameras:
            packets = list(recording.packets(camera))
            assert [packet.frame_index for packet in packets] == list(range(64))
            assert [packet.time_ns for packet in packets] == [frame.time_ns for frame in frames]
            gop = 1 if video.codec == "jpeg" else video.gop
            assert [packet.is_keyframe for packet in packets] == [index % gop == 0 for index in range(64)]
            pictures = list(recording.images(camera))
            assert len(pictures) == 64
            for frame, picture in zip(frames, pictures, strict=True):
                original = frame.images[camera].color
                assert picture.shape == original.shape
                assert picture.dtype == np.uint8
                assert frame_number(picture) == frame.frame_index
                other = frame.images["wrist" if camera == "front" else "front"].color
                errors = [np.abs(picture.astype(int) - expected).mean() for expected in (original, other)]
                assert errors[0] < 8
                assert errors[0] < errors[1]
            settings = recording.video_settings(camera)
            assert (settings.codec, settings.width, settings.height, settings.fps) == (video.codec, 64, 48, 30)


def test_what_the_settings_say_is_what_was_encoded(tmp_path: Path) -> None:
    sizes = []
    for crf in (18, 40):
        video = VideoConfig(gop=5, crf=crf, preset="medium")
        path = write_episode(tmp_path / f"{crf}.mcap", video=video, num_frames=20)
        with SimulatedRecording(path) as recording:
            settings = recording.video_settings("front")
            assert (settings.gop, settings.crf, settings.preset) == (5, crf, "medium")
            packets = list(recording.packets("front"))
            # x264 writes its settings into the first packet.
            assert f"crf={crf}.0".encode() in packets[0].data
            assert b"keyint=5" in packets[0].data
            assert b"bframes=0" in packets[0].data
            assert b"threads=1" in packets[0].data
            sizes.append(sum(len(packet.data) for packet in packets))
    assert sizes[0] > 1.5 * sizes[1]


def test_depth_and_segmentation(tmp_path: Path) -> None:
    info, frames, outcome = make_episode(num_frames=33, depth=True, segmentation=True)
    path = record(tmp_path / "a.mcap", frames, info, outcome)
    with SimulatedRecording(path) as recording:
        assert recording.has_depth("front")
        assert recording.has_segmentation("wrist")
        for camera in recording.cameras:
            for frame, depth in zip(frames, recording.depth(camera), strict=True):
                original = frame.images[camera].depth
                assert original is not None
                assert depth.dtype == np.float32
                assert np.array_equal(depth == 0, original == 0)
                assert np.abs(depth - original).max() <= 0.000501
            for frame, labels in zip(frames, recording.segmentation(camera), strict=True):
                assert labels.dtype == np.int32
                assert np.array_equal(labels, present(frame.images[camera].segmentation))
        names = recording.segment_names()
    assert names[-1] == "background"
    assert (names[0], names[1], names[3]) == ("table", "target", "cube")  # what stands still, the robot, what moves
    assert names[2 + (1 << 24)] == "panda/panda_link1"


def test_segmentation_of_several_cameras_in_one_pass(tmp_path: Path) -> None:
    path = write_episode(tmp_path / "a.mcap", num_frames=70, cameras=("front", "wrist"), segmentation=True)
    chosen = {0, 31, 32, 69}
    with SimulatedRecording(path) as recording:
        assert len(list(recording._container.blocks_by_chunk(["/camera/front/segmentation"]))) > 1
        found = list(recording.segmentation_at(["wrist", "front"], chosen))
        for camera in ("front", "wrist"):
            wanted = [labels for frame, labels in enumerate(recording.segmentation(camera)) if frame in chosen]
            pictures = [(frame, labels) for name, frame, labels in found if name == camera]
            assert [frame for frame, _ in pictures] == sorted(chosen)
            for (_, labels), values in zip(pictures, wanted, strict=True):
                body, link = np.divmod(labels.astype(np.int64), 256)  # 256 (body + 1) + link + 1, background 0
                np.testing.assert_array_equal(np.where(labels > 0, body - 1 + (link << 24), -1), values)
        assert len(found) == 2 * len(chosen)


@pytest.mark.parametrize("cameras", [("front",), ("front", "wrist")])
def test_labels_that_were_read_with_the_coded_pictures_are_not_unpacked_again(
    cameras: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_episode(tmp_path / "a.mcap", num_frames=70, cameras=cameras, segmentation=True)
    chosen = {0, 31, 69}
    with SimulatedRecording(path) as recording:
        expected = list(recording.segmentation_at(cameras, chosen))
        recording.coded_pictures(cameras)
        monkeypatch.setattr("demorec.mcap.container.chunk_content", lambda *_: pytest.fail("a chunk was unpacked"))
        found = list(recording.segmentation_at(cameras, chosen))
    for camera in cameras:
        pictures, again = ([row for row in rows if row[0] == camera] for rows in (expected, found))
        assert [row[1] for row in again] == [row[1] for row in pictures] == sorted(chosen)
        assert all(np.array_equal(a[2], b[2]) for a, b in zip(again, pictures, strict=True))


def test_without_depth_it_says_so(tmp_path: Path) -> None:
    with SimulatedRecording(write_episode(tmp_path / "a.mcap", num_frames=3)) as recording:
        assert not recording.has_depth("front")
        with pytest.raises(RecordingError, match="no depth images"):
            next(recording.depth("front"))
        with pytest.raises(RecordingError, match="no segmentation images"):
            next(recording.segmentation("front"))
        with pytest.raises(RecordingError, match=r"no camera 'top', its cameras are front, wrist"):
            next(recording.images("top"))
        assert recording.segment_names() == {}


def test_joint_samples_between_the_frames(tmp_path: Path) -> None:
    info, frames, outcome = make_episode(num_frames=40, cameras=(), physics_rate_joints=True)
    path = record(tmp_path / "a.mcap", frames, info, outcome)
    with SimulatedRecording(path) as recording:
        samples = list(recording.joint_samples())
        columns = recording.columns()
    assert len(samples) == 39 * 8 + 1
    steps = np.diff([sample.time_ns for sample in samples])
    assert steps.min() > 4_100_000
    assert steps.max() < 4_200_000
    inner = [sample for frame in frames for sample in frame.joint_samples]
    read = [sample for sample in samples if sample.time_ns not in set(columns.time_ns.tolist())]
    for written, found in zip(inner, read, strict=True):
        assert found.time_ns == written.time_ns
        assert np.array_equal(found.joint_position, written.joint_position)
        assert np.array_equal(found.joint_velocity, written.joint_velocity)
        assert np.array_equal(found.joint_effort, written.joint_effort)
    assert np.array_equal(columns.joint_position, [frame.observation.joint_position for frame in frames])


def test_events(tmp_path: Path) -> None:
    info, frames, outcome = make_episode(num_frames=40, cameras=())
    path = record(tmp_path / "a.mcap", frames, info, outcome)
    expected = [(frame.time_ns, event) for frame in frames for event in frame.events]
    assert {event.level for _, event in expected} == {"info", "warning"}
    with SimulatedRecording(path) as recording:
        assert list(recording.events()) == expected
        recording.columns()  # comes by them
        assert list(recording.events()) == expected


@pytest.mark.parametrize(("width", "height", "step"), [(64, 48, 1), (640, 480, 4)])
def test_statistics_are_of_every_other_picture(tmp_path: Path, width: int, height: int, step: int) -> None:
    """Every fourth row of it, each quarter in turn; large pictures thinned as LeRobot thins them."""
    info, frames, outcome = make_episode(num_frames=7, width=width, height=height)
    path = record(tmp_path / "a.mcap", frames, info, outcome)
    with SimulatedRecording(path) as recording:
        found = recording.pixel_statistics("wrist")
    thinned = [frame.images["wrist"].color[::step, ::step] for frame in frames[::2]]
    chosen = np.concatenate([picture[number % 4 :: 4].reshape(-1, 3) for number, picture in enumerate(thinned)])
    assert found.num_images == 4
    assert np.array_equal(found.counts, [np.bincount(chosen[:, channel], minlength=256) for channel in range(3)])


def test_statistics_are_near_those_of_all_pixels(tmp_path: Path) -> None:
    info, frames, outcome = make_episode(num_frames=60)
    path = record(tmp_path / "a.mcap", frames, info, outcome)
    with SimulatedRecording(path) as recording:
        counts = recording.pixel_statistics("front").counts
    everything = np.stack([frame.images["front"].color for frame in frames]).reshape(-1, 3).astype(float)
    mean = (counts * np.arange(256)).sum(axis=1) / counts.sum(axis=1)
    assert np.abs(mean - everything.mean(axis=0)).max() < 4.0  # the bar code shows even numbers


def test_the_same_episode_gives_the_same_bytes(tmp_path: Path) -> None:
    first = write_episode(tmp_path / "a.mcap", num_frames=35, depth=True, segmentation=True).read_bytes()
    assert write_episode(tmp_path / "b.mcap", num_frames=35, depth=True, segmentation=True).read_bytes() == first


def test_the_digest_is_of_the_content(tmp_path: Path) -> None:
    info, frames, outcome = make_episode(num_frames=8)

    def digest(name: str, **changes: Any) -> str:
        path = record(tmp_path / name, changes.get("frames", frames), changes.get("info", info), outcome)
        with SimulatedRecording(path) as recording:
            return recording.digest()

    original = digest("a.mcap")
    assert digest("b.mcap", info=replace(info, versions={"demorec": "9"})) == original
    assert digest("c.mcap", info=replace(info, root_seed=1)) != original
    observation = frames[3].observation
    effort = observation.joint_effort.copy()
    effort[2] = np.nextafter(effort[2], 99.0)
    changed = replace(frames[3], observation=replace(observation, joint_effort=effort))
    assert digest("d.mcap", frames=[*frames[:3], changed, *frames[4:]]) != original
    picture = frames[3].images["front"].color.copy()
    picture[:8, :8] = 255
    images = {**frames[3].images, "front": replace(frames[3].images["front"], color=picture)}
    assert digest("e.mcap", frames=[*frames[:3], replace(frames[3], images=images), *frames[4:]]) != original
    event = replace(frames[3], events=(Event(name="grasp", message="again"),))
    assert digest("f.mcap", frames=[*frames[:3], event, *frames[4:]]) != original


def test_no_frames_at_all(tmp_path: Path) -> None:
    info, _, outcome = make_episode(num_frames=1)
    path = record(tmp_path / "a.mcap", [], info, replace(outcome, num_frames=0, success=False))
    with SimulatedRecording(path) as recording:
        assert recording.num_frames == 0
        assert recording.columns().joint_position.shape == (0, 9)
        assert recording.cameras == ()
        assert len(recording.digest()) == 64


def test_numbers_are_read_without_touching_the_pictures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_episode(tmp_path / "a.mcap", num_frames=90, width=160, height=120, video=VideoConfig(codec="jpeg"))
    read: list[int] = []
    original = Container._read_at

    def remember(container: Container, at: int, size: int) -> bytes:
        read.append(size)
        return original(container, at, size)

    monkeypatch.setattr(Container, "_read_at", remember)
    with SimulatedRecording(path) as recording:
        opened = sum(read)
        recording.columns()
        numbers = sum(read) - opened
        list(recording.packets("front"))
        pictures = sum(read) - opened - numbers
    size = path.stat().st_size
    assert opened < 0.1 * size
    assert numbers < 0.25 * size
    assert pictures > 0.6 * size


def test_the_outcome_is_for_people_too(tmp_path: Path) -> None:
    path = write_episode(tmp_path / "a.mcap", num_frames=3, cameras=(), success=False)
    container = Container(path)
    episode, outcome = container.metadata("demorec.episode"), container.metadata("demorec.outcome")
    container.close()
    assert episode is not None
    assert outcome is not None
    assert episode["instruction"] == "pick up the red cube and place it on the green target"
    assert episode["format_version"] == str(FORMAT_VERSION)
    assert json.loads(episode["info"])["config"]["task"] == "pick_place"
    assert outcome["success"] == "false"

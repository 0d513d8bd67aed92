"""Writing and reading is bit-exact."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.recording import frame_number, make_episode, write_episode

from demorec.core.config import VideoConfig
from demorec.core.errors import RecordingError
from demorec.episode.episode import Event, Frame, Outcome
from demorec.episode.info import EpisodeInfo
from demorec.episode.simulated import with_simulation
from demorec.mcap import EpisodeWriter, Recording

CODECS = [VideoConfig(), VideoConfig(codec="av1"), VideoConfig(codec="jpeg"), VideoConfig(gop=30, crf=30)]


def record(
    path: Path, frames: list[Frame], info: EpisodeInfo, outcome: Outcome, video: VideoConfig | None = None
) -> Path:
    with EpisodeWriter(path, info, video=video) as writer:
        for frame in frames:
            writer.write(frame)
        writer.finish(outcome)
    return path


@pytest.mark.parametrize(
    ("num_frames", "cameras"), [(1, ()), (29, ()), (30, ("front", "wrist")), (31, ()), (75, ("front", "wrist"))]
)
def test_columns_are_the_frames_to_the_bit(tmp_path: Path, num_frames: int, cameras: tuple[str, ...]) -> None:
    info, frames, outcome = make_episode(num_frames=num_frames, cameras=cameras)
    path = record(tmp_path / "a.mcap", frames, info, outcome)
    with Recording(path) as recording:
        assert recording.info == info
        assert recording.outcome == outcome
        assert recording.num_frames == num_frames
        trajectory = recording.trajectory()
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
        found = getattr(trajectory, name)
        assert found.tobytes() == np.array(values, dtype=found.dtype).tobytes(), name
    assert np.array_equal(trajectory.sensed["wrench"], [o.sensed["wrench"] for o in observations])
    assert trajectory.phase == tuple(frame.phase for frame in frames)
    assert list(trajectory.object_poses) == ["cube"]
    assert np.array_equal(trajectory.object_poses["cube"], [o.object_poses["cube"].vector() for o in observations])
    assert list(trajectory.world_from_camera) == list(cameras)
    for name in cameras:
        poses = [frame.images[name].world_from_camera.vector() for frame in frames]
        assert np.array_equal(trajectory.world_from_camera[name], poses)


@pytest.mark.parametrize("video", CODECS, ids=lambda video: f"{video.codec}-{video.gop}")
def test_images(tmp_path: Path, video: VideoConfig) -> None:
    info, frames, outcome = make_episode(num_frames=64)
    path = record(tmp_path / "a.mcap", frames, info, outcome, video)
    with Recording(path) as recording:
        for camera in recording.cameras:
            packets = list(recording.packets(camera))
            assert [packet.frame_index for packet in packets] == list(range(64))
            assert [packet.time_ns for packet in packets] == [frame.time_ns for frame in frames]
            gop = 1 if video.codec == "jpeg" else video.gop
            assert [packet.is_keyframe for packet in packets] == [index % gop == 0 for index in range(64)]
            images = list(recording.images(camera))
            assert len(images) == 64
            for frame, image in zip(frames, images, strict=True):
                original = frame.images[camera].color
                assert image.shape == original.shape
                assert image.dtype == np.uint8
                assert frame_number(image) == frame.frame_index
                other = frame.images["wrist" if camera == "front" else "front"].color
                errors = [np.abs(image.astype(int) - expected).mean() for expected in (original, other)]
                assert errors[0] < 8
                assert errors[0] < errors[1]
            settings = recording.video_settings(camera)
            assert (settings.codec, settings.width, settings.height, settings.fps) == (video.codec, 64, 48, 30)


def test_missing_depth_is_an_error(tmp_path: Path) -> None:
    with Recording(write_episode(tmp_path / "a.mcap", num_frames=3)) as recording:
        assert not recording.has_depth("front")
        with pytest.raises(RecordingError, match="no depth images"):
            next(recording.depth("front"))
        with pytest.raises(RecordingError, match="no segmentation images"):
            next(recording.segmentation("front"))
        with pytest.raises(RecordingError, match=r"no camera 'top'; its cameras are front, wrist"):
            next(recording.images("top"))
        assert recording.segment_names() == {}


def test_the_same_episode_gives_the_same_bytes(tmp_path: Path) -> None:
    first = write_episode(tmp_path / "a.mcap", num_frames=35, depth=True, segmentation=True).read_bytes()
    assert write_episode(tmp_path / "b.mcap", num_frames=35, depth=True, segmentation=True).read_bytes() == first


def test_the_digest_is_of_the_content(tmp_path: Path) -> None:
    info, frames, outcome = make_episode(num_frames=8)

    def digest(name: str, **changes: Any) -> str:
        path = record(tmp_path / name, changes.get("frames", frames), changes.get("info", info), outcome)
        with Recording(path) as recording:
            return recording.digest()

    original = digest("a.mcap")
    assert digest("b.mcap", info=replace(info, versions={"demorec": "9"})) == original
    assert digest("c.mcap", info=with_simulation(info, root_seed=1)) != original
    observation = frames[3].observation
    effort = observation.joint_effort.copy()
    effort[2] = np.nextafter(effort[2], 99.0)
    changed = replace(frames[3], observation=replace(observation, joint_effort=effort))
    assert digest("d.mcap", frames=[*frames[:3], changed, *frames[4:]]) != original
    image = frames[3].images["front"].color.copy()
    image[:8, :8] = 255
    images = {**frames[3].images, "front": replace(frames[3].images["front"], color=image)}
    assert digest("e.mcap", frames=[*frames[:3], replace(frames[3], images=images), *frames[4:]]) != original
    event = replace(frames[3], events=(Event(name="grasp", message="again"),))
    assert digest("f.mcap", frames=[*frames[:3], event, *frames[4:]]) != original


def test_no_frames_at_all(tmp_path: Path) -> None:
    info, _, outcome = make_episode(num_frames=1)
    path = record(tmp_path / "a.mcap", [], info, replace(outcome, num_frames=0, success=False))
    with Recording(path) as recording:
        assert recording.num_frames == 0
        assert recording.trajectory().joint_position.shape == (0, 9)
        assert recording.cameras == ()
        assert len(recording.digest()) == 64

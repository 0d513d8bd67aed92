"""A recording in a notebook: frames with images, a table, and the examples in the docs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.docs import run_examples
from support.external import make_external, write_external
from support.present import present
from support.recording import Codec, frame_number, make_episode, write_episode

from demorec.core.config import VideoConfig
from demorec.core.errors import RecordingError
from demorec.episode.episode import Frame
from demorec.mcap import Recording, open_recording, open_simulated

NUM_FRAMES = 47


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp("notebook") / "episode_000000.mcap"
    return write_episode(target, num_frames=NUM_FRAMES, depth=True, segmentation=True, video=VideoConfig(gop=10))


@pytest.fixture(scope="module")
def truth() -> list[Frame]:
    _, frames, _ = make_episode(num_frames=NUM_FRAMES, depth=True, segmentation=True)
    return frames


def same_frame(found: Frame, true: Frame) -> None:
    assert found.frame_index == true.frame_index
    assert found.time_ns == true.time_ns
    assert found.phase == true.phase
    assert [event.name for event in found.events] == [event.name for event in true.events]
    assert np.array_equal(found.observation.joint_position, true.observation.joint_position)
    assert np.array_equal(found.command.joint_target, true.command.joint_target)
    assert list(found.images) == list(true.images)
    for camera, images in found.images.items():
        assert frame_number(images.color) == true.frame_index
        assert np.abs(images.color.astype(int) - true.images[camera].color).mean() < 12
        assert np.allclose(present(images.depth), present(true.images[camera].depth), atol=5.1e-4)
        assert np.array_equal(present(images.segmentation), present(true.images[camera].segmentation))
        assert np.allclose(images.world_from_camera.position, true.images[camera].world_from_camera.position)


def test_frames_come_with_numbers_and_images(path: Path, truth: list[Frame]) -> None:
    with Recording(path) as recording:
        assert len(recording) == NUM_FRAMES
        for found, true in zip(recording, truth, strict=True):
            same_frame(found, true)
        names = recording.segment_names()
    assert names[-1] == "background"
    assert (names[0], names[1], names[3]) == ("table", "target", "cube")  # fixed bodies, the robot, movable objects
    assert names[2 + (1 << 24)] == "panda/panda_link1"


@pytest.mark.parametrize("codec", ["h264", "av1", "jpeg"])
def test_a_picked_image_is_that_of_the_whole_stream(tmp_path: Path, codec: Codec) -> None:
    file = write_episode(tmp_path / "a.mcap", num_frames=12, video=VideoConfig(codec=codec, gop=5))
    with Recording(file) as recording:
        whole = list(recording.images("wrist"))
        for index in (11, 0, 4, 5, -3):
            assert np.array_equal(np.asarray(recording.image("wrist", index)), whole[index])


def test_the_table_holds_every_number(path: Path, truth: list[Frame]) -> None:
    with Recording(path) as recording:
        table = recording.to_pandas()
    assert table.index.name == "frame_index"
    assert list(table.index) == list(range(NUM_FRAMES))
    for row, frame in zip(table.to_dict("records"), truth, strict=True):
        seen, command = frame.observation, frame.command
        assert row["time_ns"] == frame.time_ns
        assert row["phase"] == frame.phase
        assert row["joint_position.panda_joint3"] == seen.joint_position[2]
        assert row["wrench.hand.force.z"] == seen.sensed["wrench"][2]
        assert row["object_poses.cube.qw"] == seen.object_poses["cube"].quat_xyzw[3]
        assert row["command_joint_target.panda_joint7"] == command.joint_target[6]
        assert row["action_gripper"] == frame.action.gripper_target
        assert row["world_from_camera.wrist.x"] == frame.images["wrist"].world_from_camera.position[0]
    numbers = 2 + 3 * 9 + 2 + 7 + 2 * (7 + 1 + 7) + 7 + 2 * 7 + 1
    numbers += sum(values.size for values in truth[0].observation.sensed.values())
    assert table.shape == (NUM_FRAMES, numbers)


def test_the_examples_of_the_docs_run(capsys: pytest.CaptureFixture[str]) -> None:
    """On a recording of the demo's task, since the examples name the objects on its table."""
    sample = Path(__file__).parents[2] / "recordings/sample/pick_place.mcap"
    recording = {"recordings/demo/episodes/episode_000000.mcap": sample}
    assert run_examples("docs/recording.md", "import open_recording", recording) == 2
    assert capsys.readouterr().out


def test_an_external_recording_works_in_notebooks(tmp_path: Path) -> None:
    given = make_external(num_frames=20)
    with open_recording(write_external(tmp_path / "episode.mcap", given)) as recording:
        table = recording.to_pandas()
        assert list(table.columns[:3]) == ["time_ns", "observation.state.shoulder.pos", "observation.state.elbow.pos"]
        assert table["time_ns"].tolist() == [frame.time_ns for frame in given.frames]
        forces = [frame.samples["observation.force"].vector for frame in given.frames]
        assert np.array_equal(table[[f"observation.force.{axis}" for axis in "xyz"]].to_numpy(), np.array(forces))
        with pytest.raises(RecordingError, match="needs the scene of an episode that demorec simulated"):
            next(iter(recording))
    with pytest.raises(RecordingError, match=f"needs the scene of an episode that demorec simulated.*: {tmp_path}"):
        open_simulated(tmp_path / "episode.mcap")

"""External episodes in Rerun: every feature as a plot, every camera, the robot where its URDF is known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from rerun.chunk import RrdReader
from support.external import make_external, write_external

from demorec.view.scene import save
from demorec.view.sources import find_episodes


def test_an_episode_is_shown_from_its_first_frame_on(tmp_path: Path) -> None:
    given = make_external()
    path = write_external(tmp_path / "a.mcap", given)
    with find_episodes([path])[0].open() as episode:
        assert episode.info.simulation is None
        times = [frame.time_ns - given.frames[0].time_ns for frame in given.frames]
        assert episode.time_ns.tolist() == times
        assert set(episode.curves) == {"observation.state", "action", "observation.force"}
        assert set(episode.motion.joint_position) == {"shoulder", "elbow"}
        expected = [float(frame.samples["observation.state"].vector[1]) for frame in given.frames]
        assert episode.motion.joint_position["elbow"].tolist() == expected
        shown = [time_ns for time_ns, _, _ in episode.packets("wrist")]
        assert shown == times[1::2]  # each with the first frame that holds it


def test_it_can_be_saved_without_cameras_and_a_description(tmp_path: Path) -> None:
    path = write_external(tmp_path / "a.mcap", make_external(num_frames=5, cameras=(), urdf=""))
    save(find_episodes([path])[0], tmp_path / "a.rrd")
    assert (tmp_path / "a.rrd").read_bytes().startswith(b"RR")


def test_missing_meshes_leave_the_rest_visible(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    given = make_external(num_frames=5)
    mesh = given.info.urdf.replace('<box size="0.1 0.1 0.1"/>', '<mesh filename="package://arm/base.stl"/>')
    path = write_external(tmp_path / "a.mcap", replace(given, info=replace(given.info, urdf=mesh)))
    save(find_episodes([path])[0], tmp_path / "a.rrd")
    assert "The robot is drawn as rods between its joints" in caplog.text
    drawn = {
        chunk.entity_path.rsplit("/", 1)[-1]
        for chunk in RrdReader(tmp_path / "a.rrd").stream()
        if "/robot/" in chunk.entity_path
        and {"Mesh3D:vertex_positions", "LineStrips3D:strips"} & set(chunk.to_record_batch().schema.names)
    }
    assert drawn == {"base", "upper", "lower"}  # rods to the joints of two links, and the third link's own shape

"""Recordings of collected episodes read by other people's programs: mcap's reader, rosbags, Rerun."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from support.export import export
from support.external import TOP, URDF, make_external, write_external

from demorec.mcap.ros2 import DEFINITIONS
from demorec.robots.urdf import Urdf

EPISODE = make_external()


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_external(tmp_path_factory.mktemp("collected") / "a.mcap", EPISODE)


def test_mcap_decodes_numbers_stamps_and_pictures(path: Path) -> None:
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        decoded: dict[str, list[tuple[int, Any]]] = {}
        for _, channel, message, content in reader.iter_decoded_messages():
            decoded.setdefault(channel.topic, []).append((message.log_time, content))
        assert {metadata.name for metadata in reader.iter_metadata()} == {"demorec.collected", "demorec.outcome"}
    states, forces = decoded["/observation/state"], decoded["/observation/force"]
    for frame, (time_ns, state), (_, force) in zip(EPISODE.frames, states, forces, strict=True):
        sample = frame.samples["observation.state"]
        assert time_ns == frame.time_ns
        assert state.name == ["shoulder", "elbow", "gripper.pos"]
        assert state.position == sample.vector.tolist()
        assert (state.velocity, state.effort) == ([], [])
        assert state.header.stamp.sec * 10**9 + state.header.stamp.nanosec == sample.stamp_ns
        assert force.data == frame.samples["observation.force"].vector.tolist()
        assert force.layout.dim[0].label == "x,y,z"
    rows = [content for _, content in decoded["/frames"]]
    assert rows[0].layout.dim[0].label == "observation.state,action,observation.force,top,wrist"
    assert rows[0].data[3:] == [0, -1]
    for (stamp_ns, _), (time_ns, content) in zip(EPISODE.pictures["top"], decoded["/camera/top/h264"], strict=True):
        assert time_ns == stamp_ns == content.header.stamp.sec * 10**9 + content.header.stamp.nanosec
    assert decoded["/camera/top/camera_info"][0][1].k[0] == 60.0
    assert decoded["/robot_description"][0][1].data == URDF


def test_the_transforms_are_those_of_the_urdf(path: Path) -> None:
    urdf = Urdf.parse(URDF)
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        moved = [content for *_, content in reader.iter_decoded_messages(topics=["/tf"])]
    assert len(moved) == len(EPISODE.frames)
    for frame, content in zip(EPISODE.frames, moved, strict=True):
        shoulder, elbow, _ = frame.samples["observation.state"].vector.astype(float).tolist()
        poses = urdf.link_poses({"shoulder": shoulder, "elbow": elbow})
        for transform in content.transforms:
            expected = poses[transform.header.frame_id].inverse() @ poses[transform.child_frame_id]
            rotation = transform.transform.rotation
            found = np.array((rotation.x, rotation.y, rotation.z, rotation.w))
            assert np.abs(found - expected.quat_xyzw).max() < 1e-12


def test_rosbags_reads_every_message(path: Path) -> None:
    store = get_typestore(Stores.EMPTY)
    for name, definition in DEFINITIONS.items():
        store.register(get_types_from_msg(definition, name))
    with AnyReader([path], default_typestore=store) as reader:
        counts: dict[str, int] = {}
        for connection, _, data in reader.messages():
            reader.deserialize(data, connection.msgtype)
            counts[connection.topic] = counts.get(connection.topic, 0) + 1
    assert counts["/observation/state"] == counts["/action"] == counts["/frames"] == counts["/tf"] == 45
    assert (counts["/camera/top/h264"], counts["/camera/wrist/video"]) == (45, 22)


def test_rerun_shows_joints_videos_and_frames(path: Path, tmp_path: Path) -> None:
    out = tmp_path / "a.rrd"
    command = [sys.executable, "-m", "rerun", "mcap", "convert", str(path), "-o", str(out)]
    subprocess.run(command, check=True, capture_output=True)
    told = subprocess.run(
        [sys.executable, "-m", "rerun", "rrd", "print", str(out)], check=True, capture_output=True, text=True
    ).stdout
    assert "Scalars" in told
    assert "VideoStream" in told
    assert "Transform3D" in told


@pytest.mark.slow
def test_lerobot_reads_the_dataset_as_it_was_recorded(tmp_path: Path) -> None:
    (tmp_path / "run" / "episodes").mkdir(parents=True)
    write_external(tmp_path / "run" / "episodes" / "episode_000000.mcap", make_external(cameras=(TOP,)))
    report = export(tmp_path / "run", tmp_path / "d", verify=True)
    assert (report.num_frames, report.verified_frames, report.not_verified) == (45, 2, "")

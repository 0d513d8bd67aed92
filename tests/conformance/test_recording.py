"""Recordings read by third-party programs: mcap's reader, rosbags, FFmpeg, Rerun.

Properties of any episode are tested with a simulated one and with an external one.
"""

from __future__ import annotations

import io
import re
import subprocess
import sys
import zlib
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation
from support.external import URDF, make_external, write_external
from support.present import present
from support.recording import Codec, frame_number, make_episode, write_episode

from demorec.core.config import VideoConfig
from demorec.episode.episode import Frame, Outcome
from demorec.episode.info import EpisodeInfo
from demorec.mcap.ros2 import DEFINITIONS
from demorec.robots.assets import asset_path
from demorec.robots.urdf import Urdf

NUM_FRAMES = 40
EXTERNAL = make_external()
Recorded = tuple[str, Path]


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("conformance")
    return write_episode(
        folder / "a.mcap", num_frames=NUM_FRAMES, depth=True, segmentation=True, physics_rate_joints=True
    )


@pytest.fixture(scope="module")
def external(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_external(tmp_path_factory.mktemp("external") / "a.mcap", EXTERNAL)


@pytest.fixture(params=["simulated", "external"])
def recorded(request: pytest.FixtureRequest, path: Path, external: Path) -> Recorded:
    """The kind of an episode, and its recording."""
    return request.param, path if request.param == "simulated" else external


@pytest.fixture(scope="module")
def episode() -> tuple[EpisodeInfo, list[Frame], Outcome]:
    return make_episode(num_frames=NUM_FRAMES, depth=True, segmentation=True, physics_rate_joints=True)


def test_the_mcap_reader_finds_every_checksum_right(recorded: Recorded) -> None:
    kind, path = recorded
    with path.open("rb") as stream:
        records = list(StreamReader(stream, validate_crcs=True).records)
    assert len(records) > (1000 if kind == "simulated" else 250)
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert sum(1 for _ in reader.iter_messages()) == summary.statistics.message_count
        assert {metadata.name for metadata in reader.iter_metadata()} == {
            "demorec.episode",
            "demorec.outcome",
        }
    with path.open("rb") as stream:
        data_end = [record for record in records if type(record).__name__ == "DataEnd"]
        assert data_end[0].data_section_crc not in (0, zlib.crc32(stream.read()))


def test_mcap_decodes_the_written_messages(path: Path, episode: tuple[EpisodeInfo, list[Frame], Outcome]) -> None:
    _, frames, _ = episode
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        decoded: dict[str, list[tuple[int, Any]]] = {}
        for _, channel, message, content in reader.iter_decoded_messages():
            decoded.setdefault(channel.topic, []).append((message.log_time, content))
    assert len(decoded["/joint_states"]) == (NUM_FRAMES - 1) * 8 + 1
    states = dict(decoded["/joint_states"])
    for frame in frames:
        content = states[frame.time_ns]
        assert content.name == [
            *(f"panda_joint{n}" for n in range(1, 8)),
            "panda_finger_joint1",
            "panda_finger_joint2",
        ]
        assert content.position == frame.observation.joint_position.tolist()
        assert content.velocity == frame.observation.joint_velocity.tolist()
        assert content.effort == frame.observation.joint_effort.tolist()
        assert content.header.stamp.sec * 10**9 + content.header.stamp.nanosec == frame.time_ns
    for frame, (_, content) in zip(frames, decoded["/object/cube/pose"], strict=True):
        pose, expected = content.pose, frame.observation.object_poses["cube"]
        assert content.header.frame_id == "world"
        assert [pose.position.x, pose.position.y, pose.position.z] == expected.position.tolist()
        quat = [pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w]
        assert quat == expected.quat_xyzw.tolist()
    for frame, (time, content) in zip(frames, decoded["/wrench"], strict=True):
        force, torque = content.wrench.force, content.wrench.torque
        assert (time, content.header.frame_id) == (frame.time_ns, "panda_hand")
        found = [force.x, force.y, force.z, torque.x, torque.y, torque.z]
        assert found == frame.observation.sensed["wrench"].tolist()
    info = decoded["/camera/front/camera_info"][0][1]
    assert (info.width, info.height) == (64, 48)
    assert np.allclose(info.k, [49.68, 0, 32, 0, 49.68, 24, 0, 0, 1], atol=0.01)
    assert np.array_equal(np.reshape(info.p, (3, 4))[:, :3], np.reshape(info.k, (3, 3)))
    assert [content.msg for _, content in decoded["/events"] if content.name == "grasp"] == [
        "both fingers touch the cube"
    ]
    assert {content.level for _, content in decoded["/events"]} == {20, 30}
    labels = {row.class_id: row.class_name for row in decoded["/labels"][0][1].class_map}
    assert labels[0] == "background"
    assert labels[(2 + 1) * 256 + 5] == "panda/panda_link5"
    for frame, (_, content) in zip(frames, decoded["/camera/front/segmentation"], strict=True):
        image = cv2.imdecode(np.frombuffer(bytes(content.data), dtype=np.uint8), cv2.IMREAD_UNCHANGED)
        assert image is not None
        assert image.dtype == np.uint16
        assert ((image == 0) == (present(frame.images["front"].segmentation) == -1)).all()


def test_mcap_decodes_the_numbers_stamps_and_images_of_an_external_one(external: Path) -> None:
    with external.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        decoded: dict[str, list[tuple[int, Any]]] = {}
        for _, channel, message, content in reader.iter_decoded_messages():
            decoded.setdefault(channel.topic, []).append((message.log_time, content))
    states, forces = decoded["/observation/state"], decoded["/observation/force"]
    for frame, (time_ns, state), (_, force) in zip(EXTERNAL.frames, states, forces, strict=True):
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
    for (stamp_ns, _), (time_ns, content) in zip(EXTERNAL.images["top"], decoded["/camera/top/h264"], strict=True):
        assert time_ns == stamp_ns == content.header.stamp.sec * 10**9 + content.header.stamp.nanosec
    assert decoded["/camera/top/camera_info"][0][1].k[0] == 60.0
    assert decoded["/robot_description"][0][1].data == URDF
    urdf = Urdf.parse(URDF)
    for frame, (_, content) in zip(EXTERNAL.frames, decoded["/tf"], strict=True):
        shoulder, elbow, _ = frame.samples["observation.state"].vector.astype(float).tolist()
        poses = urdf.link_poses({"shoulder": shoulder, "elbow": elbow})
        for transform in content.transforms:
            expected = poses[transform.header.frame_id].inverse() @ poses[transform.child_frame_id]
            rotation = transform.transform.rotation
            found = np.array((rotation.x, rotation.y, rotation.z, rotation.w))
            assert np.abs(found - expected.quat_xyzw).max() < 1e-12


COUNTS = {
    "simulated": {"/ee_pose": NUM_FRAMES, "/wrench": NUM_FRAMES, "/joint_states": (NUM_FRAMES - 1) * 8 + 1},
    "external": {**dict.fromkeys(("/observation/state", "/action", "/frames", "/tf", "/camera/top/h264"), 45),
                 "/camera/wrist/video": 22},
}  # fmt: skip


def test_rosbags_deserialises_every_message(recorded: Recorded) -> None:
    kind, path = recorded
    store = get_typestore(Stores.EMPTY)
    for name, definition in DEFINITIONS.items():
        store.register(get_types_from_msg(definition, name))
    counts: dict[str, int] = {}
    with AnyReader([path], default_typestore=store) as reader:
        for connection, _, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            # Messages that are read and written again have the same bytes: no field was skipped or padded differently.
            assert bytes(store.serialize_cdr(message, connection.msgtype)) == bytes(raw), connection.topic
            counts[connection.topic] = counts.get(connection.topic, 0) + 1
    assert counts | COUNTS[kind] == counts


def test_definitions_are_those_of_ros(path: Path) -> None:
    """Names, types and order of all fields match the definitions that rosbags includes for ROS 2 Humble."""
    theirs = get_typestore(Stores.ROS2_HUMBLE).fielddefs
    compared = set()
    for name, definition in DEFINITIONS.items():
        for key, ours in get_types_from_msg(definition, name).items():
            if key in theirs:
                assert ours[1] == theirs[key][1], key
                compared.add(key)
    assert {"sensor_msgs/msg/JointState", "tf2_msgs/msg/TFMessage", "sensor_msgs/msg/CameraInfo"} <= compared
    assert len(compared) >= 18


@pytest.mark.parametrize("codec", ["h264", "av1", "jpeg"])
def test_ffmpeg_decodes_the_bytes_of_the_topic(tmp_path: Path, codec: Codec) -> None:
    path = write_episode(tmp_path / "a.mcap", num_frames=NUM_FRAMES, video=VideoConfig(codec=codec))
    topic = {"h264": "/camera/wrist/h264", "av1": "/camera/wrist/video", "jpeg": "/camera/wrist/image/compressed"}
    with path.open("rb") as stream:
        if codec == "av1":
            messages = make_reader(stream).iter_messages(topics=[topic[codec]])
            packets = [protobuf_field(message.data, 3) for _, _, message in messages]
        else:
            reader = make_reader(stream, decoder_factories=[DecoderFactory()])
            packets = [bytes(content.data) for *_, content in reader.iter_decoded_messages(topics=[topic[codec]])]
    assert len(packets) == NUM_FRAMES
    name = {"h264": "h264", "av1": "obu", "jpeg": "mjpeg"}[codec]
    with av.open(io.BytesIO(b"".join(packets)), "r", format=name) as container:
        images = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert [frame_number(image.astype(np.uint8)) for image in images] == list(range(NUM_FRAMES))


def protobuf_field(message: bytes, number: int) -> bytes:
    """A field of foxglove.CompressedVideo, read with Google's protobuf library and the published schema."""
    from foxglove.messages import CompressedVideo
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    pool = descriptor_pool.DescriptorPool()
    files = descriptor_pb2.FileDescriptorSet.FromString(CompressedVideo.get_schema().data)
    for file in files.file:
        pool.Add(file)
    kind = message_factory.GetMessageClass(pool.FindMessageTypeByName("foxglove.CompressedVideo"))
    parsed = kind.FromString(message)
    assert parsed.format == "av1"
    return bytes(getattr(parsed, kind.DESCRIPTOR.fields_by_number[number].name))


def rerun_entities(path: Path, folder: Path) -> dict[str, set[str]]:
    """Entity -> archetypes that `rerun mcap convert` makes of a recording."""
    rerun = Path(sys.executable).with_name("rerun")
    result = folder / "a.rrd"
    subprocess.run([rerun, "mcap", "convert", path, "-o", result], check=True, capture_output=True, timeout=120)
    printed = subprocess.run([rerun, "rrd", "print", result], check=True, capture_output=True, text=True, timeout=120)
    entities: dict[str, set[str]] = {}
    for entity, columns in re.findall(r"- (/\S*) - data columns: \[(.*)\]", printed.stdout):
        names = {column.split(":")[0] for column in columns.split() if ":" in column}
        entities.setdefault(entity, set()).update(names - {"McapChannel", "McapSchema"})
    return entities


def test_rerun_shows_everything_without_demorec(path: Path, tmp_path: Path) -> None:
    entities = rerun_entities(path, tmp_path)
    expected = {
        "/camera/front/h264": "VideoStream",
        "/camera/wrist/h264": "VideoStream",
        "/camera/front/camera_info": "Pinhole",
        "/camera/front/depth": "EncodedDepthImage",
        "/camera/front/segmentation": "EncodedImage",
        "/joint_states/position": "Scalars",
        "/joint_states/velocity": "Scalars",
        "/joint_states/effort": "Scalars",
        "/action/position": "Scalars",
        "/gripper/position": "Scalars",
        "/tf": "Transform3D",
        "/tf_static": "Transform3D",
        "/ee_pose": "InstancePoses3D",
        "/wrench": "geometry_msgs.msg.WrenchStamped",  # Rerun shows types without an archetype like this
        "/object/cube/pose": "InstancePoses3D",
        "/events": "TextLog",
        "/phase": "TextDocument",
    }
    for entity, archetype in expected.items():
        assert archetype in entities[entity], (entity, entities[entity])
    shapes = {entity for entity, names in entities.items() if names & {"Boxes3D", "Cylinders3D", "Ellipsoids3D"}}
    for link in ("panda_link0", "panda_link5", "panda_hand", "panda_leftfinger"):
        assert any(link in entity for entity in shapes), link
    assert any("cube" in entity for entity in shapes)
    assert not any("Asset3D" in names for names in entities.values())


@pytest.mark.parametrize(
    ("codec", "entity", "archetype"),
    [("av1", "/camera/front/video", "VideoStream"), ("jpeg", "/camera/front/image/compressed", "EncodedImage")],
)
def test_rerun_shows_the_other_codecs(tmp_path: Path, codec: Codec, entity: str, archetype: str) -> None:
    path = write_episode(tmp_path / "a.mcap", num_frames=5, video=VideoConfig(codec=codec))
    assert archetype in rerun_entities(path, tmp_path)[entity]


def test_rerun_shows_joints_videos_and_frames_of_an_external_one(external: Path, tmp_path: Path) -> None:
    shown = set().union(*rerun_entities(external, tmp_path).values())
    assert {"Scalars", "VideoStream", "Transform3D"} <= shown


def test_no_description_needs_another_file(path: Path) -> None:
    """The robot of a copied recording is drawn from the recording alone."""
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        texts = [
            content.data
            for _, channel, _, content in reader.iter_decoded_messages()
            if channel.topic.endswith("robot_description")
        ]
    assert len(texts) == 4
    for text in texts:
        assert "<visual" in text
        for word in ("mesh", "filename", "package:", "file:", str(Path.home()), str(asset_path("plane.urdf").parent)):
            assert word not in text, word


def test_coordinate_frames_are_where_the_links_are(
    path: Path, episode: tuple[EpisodeInfo, list[Frame], Outcome]
) -> None:
    """Every link's pose from /tf and /tf_static, against the URDF's kinematics, which are compared with PyBullet's."""
    info, frames, _ = episode
    fixed: dict[str, tuple[str, np.ndarray[Any, Any]]] = {}
    moving: dict[int, dict[str, tuple[str, np.ndarray[Any, Any]]]] = {}
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for _, channel, message, content in reader.iter_decoded_messages(topics=["/tf", "/tf_static"]):
            rows = {row.child_frame_id: (row.header.frame_id, pose_of(row.transform)) for row in content.transforms}
            (fixed if channel.topic == "/tf_static" else moving.setdefault(message.log_time, {})).update(rows)
    assert fixed["world"][0] == "tf#/"
    robot = info.simulated.robot
    urdf = Urdf.load(asset_path(robot.urdf))
    for frame in (frames[0], frames[17], frames[-1]):
        positions = frame.observation.joint_position.tolist()
        expected = urdf.link_poses(dict(zip(robot.joint_names, positions, strict=True)))
        expected["cube"] = frame.observation.object_poses["cube"]
        expected["camera_front"] = frame.images["front"].world_from_camera
        for name, pose in expected.items():
            assert np.allclose(world_from(name, {**fixed, **moving[frame.time_ns]}), pose.matrix(), atol=1e-9), name


def pose_of(transform: Any) -> np.ndarray[Any, Any]:
    turn, shift = transform.rotation, transform.translation
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
    matrix[:3, 3] = shift.x, shift.y, shift.z
    return matrix


def world_from(frame: str, tree: dict[str, tuple[str, np.ndarray[Any, Any]]]) -> np.ndarray[Any, Any]:
    result = np.eye(4)
    while frame != "world":
        frame, parent_from_child = tree[frame]
        result = parent_from_child @ result
    return result

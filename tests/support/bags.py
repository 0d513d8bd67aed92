"""Bags as real recorders write them, written by third-party libraries: `rosbags`, `mcap`, `foxglove`.

A layout makes plain messages first, so that a test can damage them before they are written, and knows the bag's content
without reading it. Topics, types, joint names and rates are those of:

- franka: franka_ros2's joints and GELLO's leader arm at up to 1 kHz, realsense2_camera, rosbag2 with MCAP;
- so101: so101_ros2's follower and leader, usb_cam's JPEG images, rosbag2 with SQLite;
- trossen: Trossen SDK's protobuf joint states and Foxglove's CompressedVideo in MCAP.
"""

from __future__ import annotations

import functools
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2
from numpy.typing import NDArray
from PIL import Image
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

NS = 1_000_000_000
EPOCH_NS = 1_760_000_000 * NS
WIDTH, HEIGHT = 64, 48


@dataclass(frozen=True, kw_only=True, eq=False)
class Note:
    """A message before it is written.

    Attributes:
        topic, type: Topic and type of the message.
        log_ns: Recording time.
        header_ns: Time in its header.
        body: Its fields; the header is made when it is written.
        frame_id: Frame in its header.
        data: Bytes of the message, in place of a body.
    """

    topic: str
    type: str
    log_ns: int
    header_ns: int
    body: dict[str, Any] = field(default_factory=dict)
    frame_id: str = ""
    data: bytes | None = None


Notes = list[Note]


def times(rate: float, seconds: float, *, phase: float = 0.0, jitter: float = 0.03, seed: int = 0) -> list[int]:
    """Timestamps of a sensor, nanoseconds: `rate` a second, each off by at most `jitter` of the period."""
    generator = np.random.default_rng(seed)
    period = 1.0 / rate
    count = int((seconds - phase) * rate)
    off = generator.uniform(-jitter, jitter, count) * period
    return [EPOCH_NS + round((phase + k * period + off[k] + 0.01) * NS) for k in range(count)]


def motion(time_ns: int, count: int, *, shift: float = 0.0) -> NDArray[np.float64]:
    """(count,) joint positions, rad: smooth, with encoder noise."""
    t = (time_ns - EPOCH_NS) / NS
    noise = np.random.default_rng(time_ns % 2**32).normal(0, 1e-5, count)
    return np.asarray(0.5 * np.sin(2 * np.pi * 0.4 * t + np.arange(count) * 0.7 + shift) + noise)


def image(time_ns: int, camera: int) -> NDArray[np.uint8]:
    """(HEIGHT, WIDTH, 3): a different colour for each camera, with a bar that moves."""
    pixels = np.full((HEIGHT, WIDTH, 3), (40 + 60 * camera, 200 - 50 * camera, 90), np.uint8)
    x = int((time_ns - EPOCH_NS) / NS * 25) % (WIDTH - 8)
    pixels[8:40, x : x + 8] = 250
    pixels[0, 0] = [(time_ns // 1000) % 251, camera, 7]
    return pixels


def jpeg(image: NDArray[np.uint8]) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="JPEG", quality=90)
    return buffer.getvalue()


def messages(
    topic: str,
    type_name: str,
    moments: Sequence[int],
    body: Callable[[int], dict[str, Any]],
    *,
    latency_ns: int = 0,
    has_header: bool = True,
    frame_id: str = "",
) -> Notes:
    """Messages with a body for each time; `latency_ns` is the delay of their recording."""
    return [
        Note(
            topic=topic,
            type=type_name,
            log_ns=moment + latency_ns,
            header_ns=moment if has_header else 0,
            body=body(moment),
            frame_id=frame_id,
        )
        for moment in moments
    ]


def joints(
    topic: str, names: Sequence[str], moments: Sequence[int], *, shift: float = 0.0, latency_ns: int = 500_000
) -> Notes:
    def body(moment: int) -> dict[str, Any]:
        return {"name": list(names), "position": motion(moment, len(names), shift=shift)}

    return messages(topic, "sensor_msgs/msg/JointState", moments, body, latency_ns=latency_ns)


def raw_images(topic: str, moments: Sequence[int], camera: int, frame_id: str) -> Notes:
    def body(moment: int) -> dict[str, Any]:
        return {"encoding": "rgb8", "width": WIDTH, "height": HEIGHT, "data": image(moment, camera)}

    return messages(topic, "sensor_msgs/msg/Image", moments, body, latency_ns=20_000_000, frame_id=frame_id)


def jpeg_images(topic: str, moments: Sequence[int], camera: int, frame_id: str) -> Notes:
    def body(moment: int) -> dict[str, Any]:
        return {"format": "jpeg", "data": np.frombuffer(jpeg(image(moment, camera)), np.uint8)}

    return messages(topic, "sensor_msgs/msg/CompressedImage", moments, body, latency_ns=15_000_000, frame_id=frame_id)


FRANKA_JOINTS = tuple(f"fr3_joint{k}" for k in range(1, 8))
FRANKA_FINGERS = ("fr3_finger_joint1", "fr3_finger_joint2")
SO101_JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")


def franka(seconds: float = 2.0) -> Notes:
    """A Franka arm with GELLO and two RealSense cameras."""
    names = (*FRANKA_JOINTS, *FRANKA_FINGERS)
    notes = joints("/joint_states", names, times(1000, seconds, seed=1), latency_ns=200_000)
    notes += joints("/gello/joint_states", FRANKA_JOINTS, times(100, seconds, seed=2), shift=0.1)
    for camera, name in enumerate(("wrist_camera", "scene_camera")):
        moments = times(30, seconds, seed=4 + camera)
        notes += raw_images(f"/camera/{name}/color/image_raw", moments, camera, name)
        notes += messages(f"/camera/{name}/color/camera_info", "sensor_msgs/msg/CameraInfo", moments, _intrinsics)
    return notes


def _intrinsics(_: int) -> dict[str, Any]:
    return {"k": np.array([60.0, 0, 32, 0, 60.0, 24, 0, 0, 1])}


def pose(moment: int) -> dict[str, Any]:
    angle = 0.3 * np.sin((moment - EPOCH_NS) / NS)
    position = motion(moment, 3)
    return {
        "position": dict(zip("xyz", position.tolist(), strict=True)),
        "orientation": {"x": 0.0, "y": 0.0, "z": float(np.sin(angle / 2)), "w": float(np.cos(angle / 2))},
    }


def so101(seconds: float = 2.0) -> Notes:
    """An SO-101 leader and follower with two USB cameras."""
    notes = joints("/follower/joint_states", SO101_JOINTS, times(50, seconds, seed=1))
    notes += joints("/leader/joint_states", SO101_JOINTS, times(50, seconds, phase=0.004, seed=2), shift=0.1)
    topics = ("/follower/cam_front/image_raw/compressed", "/static_camera/cam_side/image_raw/compressed")
    for camera, topic in enumerate(topics):
        notes += jpeg_images(topic, times(30, seconds, seed=3 + camera), camera, topic.split("/")[2])
    return notes


def trossen(seconds: float = 2.0, *, gop: int = 10) -> Notes:
    """Trossen's arms and cameras, the images encoded as H.264."""
    notes: Notes = []
    for number, arm in enumerate(("leader", "follower")):

        def positions(moment: int, shift: float = 0.1 * number) -> dict[str, Any]:
            return {"positions": motion(moment, 7, shift=shift).astype(np.float32)}

        moments = times(200, seconds, seed=1 + number)
        notes += messages(f"{arm}/joints/state", "trossen_sdk.msg.JointState", moments, positions)
    for camera, name in enumerate(("cam_high", "cam_wrist")):
        moments = times(30, seconds, seed=3 + camera)
        packets = dict(zip(moments, video([image(moment, camera) for moment in moments], gop=gop), strict=True))

        def encoded(moment: int, packets: dict[int, bytes] = packets) -> dict[str, Any]:
            return {"format": "h264", "data": packets[moment]}

        notes += messages(f"/cameras/{name}/image", "foxglove.CompressedVideo", moments, encoded, frame_id=name)
    return notes


def video(
    images: Sequence[NDArray[np.uint8]], *, gop: int, codec: str = "libx264", pixels: str = "yuv420p"
) -> list[bytes]:
    """One packet an image, parameter sets before each keyframe."""
    context = av.CodecContext.create(codec, "w")
    assert isinstance(context, av.VideoCodecContext)
    context.width, context.height, context.pix_fmt = WIDTH, HEIGHT, pixels
    context.framerate, context.time_base = Fraction(30), Fraction(1, 30)
    context.gop_size = gop
    context.options = {"bf": "0", "tune": "zerolatency", "sc_threshold": "0"}  # no keyframes except those of the GOP
    if codec == "libx265":
        context.options = {"tune": "zerolatency", "x265-params": "bframes=0:repeat-headers=1:log-level=none"}
    packets = []
    for image in images:
        packets += context.encode(av.VideoFrame.from_ndarray(image, format="rgb24"))
    packets += context.encode(None)
    return [bytes(packet) for packet in packets]


@functools.cache
def _store(*, is_ros1: bool = False) -> Any:
    return get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)


def _filled(store: Any, name: str, body: dict[str, Any], is_ros1: bool) -> Any:
    from rosbags.interfaces import Nodetype

    values = {}
    for key, (kind, rest) in store.fielddefs[name][1]:
        given = body.get(key)
        if kind == Nodetype.NAME:
            if isinstance(given, Note):
                sec, nanosec = divmod(given.header_ns, NS)
                stamp = store.types["builtin_interfaces/msg/Time"](sec=sec, nanosec=nanosec)
                extra = {"seq": 0} if is_ros1 else {}
                values[key] = store.types[rest](stamp=stamp, frame_id=given.frame_id, **extra)
            elif rest == "builtin_interfaces/msg/Time":
                values[key] = store.types[rest](sec=0, nanosec=0)
            else:
                values[key] = _filled(store, rest, given or {}, is_ros1)
        elif kind == Nodetype.BASE:
            values[key] = given if given is not None else "" if rest[0] == "string" else 0
        elif rest[0][0] == Nodetype.NAME:
            items = given or [{}] * (rest[1] if kind == Nodetype.ARRAY else 0)
            values[key] = [_filled(store, rest[0][1], item, is_ros1) for item in items]
        elif given is not None and rest[0][1][0] != "string":
            values[key] = np.asarray(given, rest[0][1][0]).reshape(-1)
        elif rest[0][1][0] == "string":
            values[key] = given or []
        else:
            length = rest[1] if kind == Nodetype.ARRAY else 0
            values[key] = np.zeros(length, rest[0][1][0])
    return store.types[name](**values)


def write_rosbag2(
    notes: Notes,
    path: Path,
    *,
    storage: StoragePlugin = StoragePlugin.MCAP,
    compression: CompressionMode | None = None,
) -> Path:
    """Write a folder of rosbag2 with `rosbags`."""
    writer = Writer(path, version=9, storage_plugin=storage)
    if compression is not None:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    return _written(writer, notes, path, is_ros1=False)


def write_ros1(notes: Notes, path: Path, *, compression: Ros1Writer.CompressionFormat | None = None) -> Path:
    """Write a bag of ROS 1 with `rosbags`."""
    writer = Ros1Writer(path)
    if compression is not None:
        writer.set_compression(compression)
    return _written(writer, notes, path, is_ros1=True)


def _written(writer: Any, notes: Notes, path: Path, *, is_ros1: bool) -> Path:
    store = _store(is_ros1=is_ros1)
    with writer:
        connections: dict[str, Any] = {}
        for note in notes:
            if note.topic not in connections:
                connections[note.topic] = writer.add_connection(note.topic, note.type, typestore=store)
            writer.write(connections[note.topic], note.log_ns, _serialised(note, is_ros1=is_ros1))
    return path


def _serialised(note: Note, *, is_ros1: bool) -> bytes:
    if note.data is not None:
        return note.data
    store = _store(is_ros1=is_ros1)
    serialise: Callable[..., memoryview] = store.serialize_ros1 if is_ros1 else store.serialize_cdr
    return bytes(serialise(_filled(store, note.type, note.body | {"header": note}, is_ros1), note.type))


def write_mcap(
    notes: Notes,
    path: Path,
    *,
    is_ros1: bool = False,
    compression: str = "zstd",
    use_chunking: bool = True,
    **options: Any,
) -> Path:
    """Write an MCAP file of ROS messages with `mcap`; `rosbags` serialises those of ROS 1."""
    from mcap.writer import CompressionType
    from mcap.writer import Writer as McapWriter

    store = _store(is_ros1=is_ros1)
    with path.open("wb") as file:
        kinds = {"": CompressionType.NONE, "zstd": CompressionType.ZSTD, "lz4": CompressionType.LZ4}
        writer = McapWriter(file, compression=kinds[compression], use_chunking=use_chunking, **options)
        writer.start(profile="ros1" if is_ros1 else "ros2")
        channels: dict[str, int] = {}
        for note in notes:
            if note.topic not in channels:
                text, _ = store.generate_msgdef(note.type, ros_version=1 if is_ros1 else 2)
                schema = writer.register_schema(
                    note.type.replace("/msg/", "/") if is_ros1 else note.type,
                    "ros1msg" if is_ros1 else "ros2msg",
                    text.encode(),
                )
                channels[note.topic] = writer.register_channel(note.topic, "ros1" if is_ros1 else "cdr", schema)
            data = _serialised(note, is_ros1=is_ros1)
            writer.add_message(channels[note.topic], note.log_ns, data, note.log_ns)
        writer.finish()
    return path


@functools.cache
def _trossen_type() -> tuple[Any, bytes]:
    """The class and the definition of Trossen's joint states."""
    stamp = descriptor_pb2.FileDescriptorProto.FromString(timestamp_pb2.DESCRIPTOR.serialized_pb)
    times_file = descriptor_pb2.FileDescriptorProto(
        name="Timestamp.proto", package="trossen_sdk", syntax="proto3", dependency=[stamp.name]
    )
    holder = times_file.message_type.add(name="Timestamp")
    for number, name in enumerate(("monotonic", "realtime"), 1):
        holder.field.add(name=name, number=number, type=11, label=1, type_name=".google.protobuf.Timestamp")
    main = descriptor_pb2.FileDescriptorProto(
        name="JointState.proto", package="trossen_sdk.msg", syntax="proto3", dependency=[times_file.name]
    )
    state = main.message_type.add(name="JointState")
    state.field.add(name="ts", number=1, type=11, label=1, type_name=".trossen_sdk.Timestamp")
    state.field.add(name="seq", number=2, type=4, label=1)
    for number, name in enumerate(("positions", "velocities", "efforts"), 3):
        state.field.add(name=name, number=number, type=2, label=3)
    files = descriptor_pb2.FileDescriptorSet(file=[stamp, times_file, main])
    pool = descriptor_pool.DescriptorPool()
    for file in files.file:
        pool.Add(file)
    kind = message_factory.GetMessageClass(pool.FindMessageTypeByName("trossen_sdk.msg.JointState"))
    return kind, files.SerializeToString()


def write_trossen(notes: Notes, path: Path) -> Path:
    """Write an MCAP file of protobuf messages with `foxglove`."""
    import foxglove
    from foxglove.channels import CompressedVideoChannel
    from foxglove.mcap import MCAPCompression, MCAPWriteOptions
    from foxglove.messages import CompressedVideo, Timestamp

    context = foxglove.Context()
    kind, definition = _trossen_type()
    options = MCAPWriteOptions(compression=MCAPCompression.Lz4, profile="trossen")
    with foxglove.open_mcap(path, context=context, writer_options=options):
        channels: dict[str, Any] = {}
        for note in notes:
            seconds, nanos = divmod(note.header_ns, NS)
            if note.type == "foxglove.CompressedVideo":
                channel = channels.get(note.topic) or CompressedVideoChannel(note.topic, context=context)
                channels[note.topic] = channel
                stamp = Timestamp(seconds, nanos)
                channel.log(CompressedVideo(timestamp=stamp, frame_id=note.frame_id, **note.body), log_time=note.log_ns)
                continue
            if note.topic not in channels:
                schema = foxglove.Schema(name=note.type, encoding="protobuf", data=definition)
                channels[note.topic] = foxglove.Channel(
                    note.topic, schema=schema, message_encoding="protobuf", context=context
                )
            message = kind(positions=note.body["positions"].tolist())
            message.ts.realtime.seconds, message.ts.realtime.nanos = seconds, nanos
            channels[note.topic].log(note.data or message.SerializeToString(), log_time=note.log_ns)
    return path


def in_order(notes: Notes) -> Notes:
    """Sort messages by recording time, as a recorder receives them."""
    return sorted(notes, key=lambda note: note.log_ns)


def of_topic(notes: Notes, topic: str) -> Notes:
    """Messages of a topic, in the order of their headers."""
    return sorted((note for note in notes if note.topic == topic), key=lambda note: note.header_ns)


def changed(notes: Notes, topic: str, change: Callable[[int, Note], Note | None]) -> Notes:
    """Copy messages, with those of a topic changed or left out by their number."""
    result: Notes = []
    number = 0
    for note in notes:
        if note.topic != topic:
            result.append(note)
            continue
        other = change(number, note)
        number += 1
        if other is not None:
            result.append(other)
    return result


def with_body(note: Note, **fields: Any) -> Note:
    return replace(note, body=note.body | fields)

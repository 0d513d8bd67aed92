"""Does what a recording says twice agree: for other programs' sake the same is there in several forms.

Each form is made again from the other and compared, the moving coordinate frames by kinematics written apart.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from demorec.check.base import PICTURE_TOPICS, Found, Measurement, NotMeasured, alignment_check, file_check, worst_frame
from demorec.check.episode import CheckedEpisode
from demorec.check.rows import displacement, matrices
from demorec.core.errors import SceneError
from demorec.episode.episode import Event
from demorec.episode.scene import SceneCamera
from demorec.mcap import channels, messages, metadata
from demorec.mcap.container import damage_as_recording_error
from demorec.mcap.lossless import DEPTH_FORMAT, LABELS_FORMAT
from demorec.mcap.streams import frame_streams
from demorec.mcap.transforms import WORLD, FrameTree, camera_frame, transforms_layout


@file_check(
    measures="messages said once that are not what the metadata make of them",
    reads=(
        "/tf_static",
        "/robot_description",
        "/object/{body}/robot_description",
        "/camera/{camera}/camera_info",
        "/labels",
        "info.robot.urdf",
        "info.scene.cameras",
        "info.scene.bodies.name",
        "info.scene.bodies.world_from_body",
        "info.scene.bodies.shape",
        "info.scene.bodies.rgba",
    ),
)
def latched_messages(episode: CheckedEpisode) -> Found:
    """Standing frames, descriptions, calibration (K, D, R, P, frame) and the labels' names follow from the metadata."""
    has_labels = any(episode.recording.has_segmentation(camera.name) for camera in episode.cameras)
    try:
        expected = list(channels.latched_messages(episode.info, FrameTree(episode.info), has_labels=has_labels))
    except SceneError as error:
        return NotMeasured(why=f"a model is not to be had here: {error}")
    wrong = []
    for topic, schema, data in expected:
        found = episode.scan.get(topic)
        if found is None or found.schema != schema or len(found.time_ns) != 1:
            wrong.append(f"{topic} is not there once")
        elif found.first != data:
            wrong.append(f"{topic} says something else")
    return Measurement(value=len(wrong), detail="; ".join(wrong[:3]) or f"{len(expected)} messages")


@file_check(
    measures="values of the metadata's summary that its description contradicts",
    reads=("metadata demorec.episode", "metadata demorec.outcome"),
)
def metadata_agrees(episode: CheckedEpisode) -> Measurement:
    """What the metadata say in short, for people and other tools, is what they say at length."""
    info, outcome = episode.info, episode.outcome
    brief = episode.container.metadata(metadata.EPISODE) or {}
    brief_outcome = episode.container.metadata(metadata.OUTCOME) or {}
    said: dict[str, object] = {
        "task": info.task,
        "instruction": info.instruction,
        "episode_index": info.episode_index,
        "attempt": info.attempt,
        "root_seed": info.root_seed,
    }
    wrong = [f"{name} is {brief.get(name)!r}, not {value!r}" for name, value in said.items()
             if brief.get(name) != str(value)]  # fmt: skip
    if outcome is not None and brief_outcome.get("success") != str(outcome.success).lower():
        wrong.append(f"success is {brief_outcome.get('success')!r}, not {outcome.success}")
    return Measurement(value=len(wrong), detail="; ".join(wrong[:3]))


@alignment_check(
    measures="moving coordinate frames against joints and object poses",
    unit="m",
    warn=1e-6,
    fail=1e-4,
    reads=(
        "/tf",
        "/joint_states",
        "/object/{body}/pose",
        "/robot_description",
    ),
)
def moving_frames(episode: CheckedEpisode) -> Iterator[Found]:
    """Every frame of /tf is where forward kinematics of the joints, or the object's pose, puts it.

    Distances in metres, with 0.1 m per rad of rotation.
    """
    robot, c = episode.info.robot, episode.columns
    joints = [joint for joint in episode.urdf.joints if joint.kind != "fixed" and joint.name in robot.joint_names]
    names = [body.name for body in episode.info.scene.movable]
    layout = transforms_layout([*((j.parent, j.child) for j in joints), *((WORLD, name) for name in names)])
    block = episode.block(channels.TF)
    with damage_as_recording_error(episode.path):
        rows = layout.decode_rows(block.rows(len(layout.constant)))
    if len(rows) != c.num_frames:
        yield Measurement(value=math.inf, detail=f"{len(rows)} messages for {c.num_frames} frames")
        return
    stale = [a != b for a, b in zip(layout.encode(block.time_ns.tolist(), rows), block.messages(), strict=True)]
    if any(stale):
        yield Measurement(value=math.inf, frame=stale.index(True), detail="stamps inside are of another time")
        return
    values = rows.reshape(len(rows), -1, 7)
    expected = [episode.recorded_kinematics.parent_from_child(joint) for joint in joints]
    expected += [episode.world_from_object(name) for name in names]
    for index, (name, poses) in enumerate(zip([*(j.child for j in joints), *names], expected, strict=True)):
        yield worst_frame(displacement(matrices(values[:, index]), poses), name)


@alignment_check(
    measures="values that follow from others of the same frame, largest difference",
    warn=1e-9,
    fail=1e-6,
    reads=(
        "/gripper",
        "/action",
        "/command",
        "/joint_states",
    ),
)
def derived_values(episode: CheckedEpisode) -> Iterator[Found]:
    """The velocity of the opening is that of the finger joints; only positions are commanded (zeros elsewhere)."""
    n, c = episode.num_arm, episode.columns
    for stream in frame_streams(episode.info):
        if stream.topic not in (channels.GRIPPER, channels.ACTION, channels.COMMAND):
            continue
        with damage_as_recording_error(episode.path):
            values = stream.layout.decode_rows(episode.block(stream.topic).rows(len(stream.layout.constant)))
        expected = values.copy()
        if stream.topic == channels.GRIPPER:
            gripper = episode.info.robot.gripper
            expected[:, 1] = gripper.width_velocity(c.joint_position[:, n:], c.joint_velocity[:, n:])
        else:
            expected[:, n + 1 :] = 0.0
        yield worst_frame(np.abs(values - expected).max(axis=1), stream.topic)


@file_check(
    measures="events that are no log of the changes of phase, or not as they are written",
    reads=(
        "/events",
        "/phase",
    ),
)
def phase_events(episode: CheckedEpisode) -> Measurement:
    """Every change of /phase is in /events at the same time, and no other; every event reads and writes alike."""
    phases, events = episode.block(channels.PHASE), episode.block(channels.EVENTS)
    logged, wrong = [], 0
    with damage_as_recording_error(episode.path):
        told = map(messages.read_string, phases.messages())
        changes = list(zip(phases.time_ns.tolist(), told, strict=True))
        for time_ns, data in zip(events.time_ns.tolist(), events.messages(), strict=True):
            event = messages.read_log(data)
            wrong += data != messages.log(time_ns, event)
            if event.name == channels.PHASE_EVENT:
                logged.append((time_ns, event.message))
                wrong += event != Event(name=event.name, message=event.message)
    again = sum(before[1] == after[1] for before, after in pairwise(changes))
    missing = sorted(set(changes) ^ set(logged))
    frame = None if not missing else int(np.searchsorted(episode.frame_times, missing[0][0]))
    detail = f"{missing[0][1]!r} is in one of the two" if missing else f"{len(changes)} phases"
    return Measurement(value=len(missing) + wrong + again, frame=frame, detail=detail)


@file_check(
    measures="picture messages that are not what their coded pictures make of them",
    reads=(*PICTURE_TOPICS, "cameras.video.codec"),
)
def picture_messages(episode: CheckedEpisode) -> Iterator[Found]:
    """/video has the pictures of /h264 byte for byte; every message has its camera's frame, its format and its time."""
    for camera in episode.cameras:
        yield _picture_messages(episode, camera)


def _picture_messages(episode: CheckedEpisode, camera: SceneCamera) -> Measurement:
    name, frame_id = camera.name, camera_frame(camera.name)
    codec = episode.recording.video_settings(name).codec
    color = messages.PictureMessages(frame_id, codec)
    topics = {channels.video_topic(name, codec): color, channels.camera_topic(name, "video"): color}
    topics[channels.camera_topic(name, "depth")] = messages.PictureMessages(frame_id, DEPTH_FORMAT)
    topics[channels.camera_topic(name, "segmentation")] = messages.PictureMessages(frame_id, LABELS_FORMAT)
    copies: dict[int, bytes] = {}
    wrong, first = 0, None
    for topic, time_ns, data in episode.container.messages(tuple(topics)):
        with damage_as_recording_error(episode.path):
            if codec == "av1" and topic == channels.video_topic(name, codec):
                same = data == messages.protobuf_video(time_ns, frame_id, codec, messages.read_protobuf_video(data))
            elif topic == channels.camera_topic(name, "video"):
                same = data == color.compressed_video(time_ns, copies.pop(time_ns, b""))
            else:
                picture = messages.read_compressed_image(data)
                same = data == topics[topic].compressed_image(time_ns, picture)
                if codec == "h264" and topic == channels.video_topic(name, codec):
                    copies[time_ns] = picture
        if not same:
            wrong += 1
            first = first if first is not None else int(np.searchsorted(episode.frame_times, time_ns))
    wrong += len(copies)
    return Measurement(value=wrong, frame=first, detail=f"camera {name}")

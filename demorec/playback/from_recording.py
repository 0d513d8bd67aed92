"""Episodes out of recordings."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np

from demorec.playback.episode import Curves, PlayedEpisode, Video, timed
from demorec.recording import Recording
from demorec.recording.channels import description_topic
from demorec.scene.episode import EpisodeColumns


@contextmanager
def open_recording(path: Path, *, group: str) -> Iterator[PlayedEpisode]:
    """The episode of a recording; its pictures can be read until the context is left.

    Raises:
        RecordingError: It cannot be read.
    """
    with Recording(path) as recording:
        info, columns = recording.info, recording.columns()
        yield PlayedEpisode(
            name=path.name.removesuffix(".mcap"),
            group=group,
            identity=hashlib.sha256(str(path.resolve()).encode()).hexdigest()[:16],
            source=path.name,
            info=info,
            outcome=recording.outcome,
            robot_description=recording.description(),
            body_description=partial(_body_description, recording),
            time_ns=columns.time_ns,
            joint_position=columns.joint_position,
            base_from_tcp=columns.base_from_tcp,
            object_poses=columns.object_poses,
            world_from_camera=columns.world_from_camera,
            phase=columns.phase,
            events=tuple(recording.events()),
            curves=_curves(recording, columns),
            videos={
                name: Video(codec=recording.video_settings(name).codec, packets=partial(_packets, recording, name))
                for name in recording.cameras
            },
            depth={
                name: partial(timed, columns.time_ns, partial(recording.depth, name))
                for name in recording.cameras
                if recording.has_depth(name)
            },
            segmentation={
                name: partial(recording.segmentation, name)
                for name in recording.cameras
                if recording.has_segmentation(name)
            },
            segment_names=recording.segment_names(),
        )


def _body_description(recording: Recording, body: str) -> str | None:
    return recording.description(body) if description_topic(body) in recording.topics else None


def _packets(recording: Recording, camera: str) -> Iterator[tuple[int, bytes, bool]]:
    for packet in recording.packets(camera):
        yield packet.time_ns, packet.data, packet.is_keyframe


def _curves(recording: Recording, columns: EpisodeColumns) -> dict[str, Curves]:
    """All plots; joints at the rate at which they were recorded, which may be that of the physics."""
    robot = recording.info.robot
    time_ns = columns.time_ns
    position, velocity, effort = columns.joint_position, columns.joint_velocity, columns.joint_effort
    if recording.topics["/joint_states"][1] > recording.num_frames:
        samples = list(recording.joint_samples())
        time_ns = np.array([sample.time_ns for sample in samples], dtype=np.int64)
        position = np.array([sample.joint_position for sample in samples])
        velocity = np.array([sample.joint_velocity for sample in samples])
        effort = np.array([sample.joint_effort for sample in samples])
    num_arm = len(robot.arm_joints)
    frames = columns.time_ns
    wrench = {}
    if columns.wrench is not None:
        wrench = {
            "hand force": Curves(time_ns=frames, values=columns.wrench[:, :3], names=("x", "y", "z")),
            "hand torque": Curves(time_ns=frames, values=columns.wrench[:, 3:], names=("x", "y", "z")),
        }
    return {
        "position": Curves(time_ns=time_ns, values=position[:, :num_arm], names=robot.arm_joints),
        "velocity": Curves(time_ns=time_ns, values=velocity[:, :num_arm], names=robot.arm_joints),
        "effort": Curves(time_ns=time_ns, values=effort[:, :num_arm], names=robot.arm_joints),
        "target": Curves(time_ns=frames, values=columns.action_joint_target, names=robot.arm_joints),
        "gripper": Curves(time_ns=frames, values=columns.gripper_width[:, None], names=("opening",)),
        "gripper target": Curves(time_ns=frames, values=columns.action_gripper[:, None], names=("target",)),
        "force": Curves(time_ns=frames, values=columns.contact_force[:, None], names=("contact force",)),
        "ee": Curves(time_ns=frames, values=columns.base_from_tcp[:, :3], names=("x", "y", "z")),
        **wrench,
    }

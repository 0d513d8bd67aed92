"""Episodes out of recordings."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.core.geometry import Array
from demorec.episode.episode import NO_IMAGE, Table, Trajectory
from demorec.episode.info import EpisodeInfo
from demorec.episode.roles import NO_NAMES, ROLES, NamedRoles, Roles, roles_of_recording
from demorec.episode.simulated import on_request
from demorec.mcap import Recording, open_recording
from demorec.mcap.channels import JOINT_STATES, description_topic
from demorec.mcap.protocol import Episode
from demorec.mcap.transforms import joint_places, joint_positions
from demorec.runs.run_file import EPISODES, FAILED
from demorec.view.episode import EFFORT_CURVES, Curves, PlayedEpisode, Video, simulated_curves, timed


@contextmanager
def open_recorded(path: Path, named: NamedRoles = NO_NAMES) -> Iterator[PlayedEpisode]:
    """The episode of a recording; its images can be read until the context is left.

    Raises:
        ConfigError: It lacks a feature whose role the user names, or is simulated.
        RecordingError: It cannot be read.
    """
    folder = path.resolve().parent
    known = {
        "name": path.name.removesuffix(".mcap"),
        "group": folder.parent.name if folder.name in (EPISODES, FAILED) else folder.name,
        "identity": hashlib.sha256(os.fsencode(path.resolve())).hexdigest()[:16],
        "source": path.name,
    }
    with open_recording(path) as recording:
        times = recording.time_ns
        statements = tuple((int(times[frame] - times[0]), "subtask", text) for frame, text in recording.subtasks)
        roles = roles_of_recording(recording.info, named)
        episode = played_episode(recording, known | {"statements": statements}, recording.info, roles)
        yield episode if episode.scene is None else _with_simulation(episode, recording)


def _with_simulation(episode: PlayedEpisode, recording: Recording) -> PlayedEpisode:
    info, trajectory = recording.info, recording.trajectory()
    return replace(
        episode,
        robot_description=recording.description(),
        body_description=lambda body: (
            recording.description(body) if description_topic(body) in recording.topics else None
        ),
        joint_position=dict(zip(info.simulated.robot.joint_names, trajectory.joint_position.T, strict=True)),
        base_from_tcp=trajectory.base_from_tcp,
        object_poses=trajectory.object_poses,
        world_from_camera=trajectory.world_from_camera,
        phase=trajectory.phase,
        events=tuple(recording.events()),
        curves=_curves(recording, trajectory),
        segmentation={
            name: partial(recording.segmentation, name)
            for name in recording.cameras
            if recording.has_segmentation(name)
        },
        segment_names=recording.segment_names(),
    )


def played_episode(recording: Episode, known: dict[str, Any], info: EpisodeInfo, roles: Roles) -> PlayedEpisode:
    """What every episode has: features and images; `info` may describe its robot. Curves are in the order of roles."""
    table = recording.table()
    time_ns = table.time_ns - (table.time_ns[0] if table.num_frames else 0)
    places = joint_places(info.features)
    positions: Iterable[Array] = joint_positions(places, table.features).T if places else ()
    return PlayedEpisode(
        **known,
        info=info,
        roles={name: role for name, role in roles.of.items() if role is not None},
        robot_description=info.urdf or None,
        outcome=recording.outcome,
        time_ns=time_ns,
        joint_position=dict(zip(places, positions, strict=True)),
        curves={
            feature.name: Curves(
                time_ns=time_ns, values=table.features[feature.name].astype(np.float64), names=feature.names
            )
            for feature in sorted(info.features, key=lambda feature: ROLES.index(roles.of[feature.name]))
        },
        videos={
            camera: video_of(recording, camera, shown_at(table, camera, time_ns))
            for camera in recording.cameras
            if len(table.image_stamps[camera])
        },
        depth={
            camera: partial(timed, shown_at(table, camera, time_ns), partial(recording.distances, camera))
            for camera in recording.depth_cameras
            if len(table.image_stamps[camera])
        },
    )


def shown_at(table: Table, camera: str, time_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """(P,) when each image of a camera is shown: with the first frame that holds it, or the next one after it.

    Not at its own stamp, which may be of another clock.
    """
    frames = np.flatnonzero(table.images[camera] != NO_IMAGE)
    numbers = np.maximum.accumulate(table.images[camera][frames])
    count = len(table.image_stamps[camera])
    places = np.minimum(np.searchsorted(numbers, np.arange(count)), max(len(frames) - 1, 0))
    return time_ns[frames[places]] if len(frames) else np.zeros(count, dtype=np.int64)


def video_of(recording: Episode, camera: str, shown_at: NDArray[np.int64]) -> Video:
    """The coded images of a camera, each at its time (P,)."""

    def packets() -> Iterator[tuple[int, bytes, bool]]:
        for packet in recording.packets(camera):
            yield int(shown_at[packet.frame_index]), packet.data, packet.is_keyframe

    return Video(codec=recording.video_settings(camera).codec, packets=packets)


def _curves(recording: Recording, trajectory: Trajectory) -> dict[str, Curves]:
    """All plots; joints at the rate at which they were recorded, which may be that of the physics."""
    robot = recording.info.simulated.robot
    result = simulated_curves(
        robot,
        trajectory.time_ns,
        recording.table().features,
        on_request(recording.info),
        joints={
            "position": trajectory.joint_position,
            "velocity": trajectory.joint_velocity,
            "target": trajectory.action_joint_target,
        },
        opening=trajectory.gripper_width,
        target=trajectory.action_gripper,
        base_from_tcp=trajectory.base_from_tcp,
    )
    if recording.topics[JOINT_STATES][1] > recording.num_frames:
        samples = list(recording.joint_samples())
        time_ns = np.array([sample.time_ns for sample in samples], dtype=np.int64)
        for name, quantity in (("position", "position"), ("velocity", "velocity"), (EFFORT_CURVES, "effort")):
            values = np.array([getattr(sample, f"joint_{quantity}") for sample in samples])
            values = values[:, : len(robot.arm_joints)]
            result[name] = Curves(time_ns=time_ns, values=values, names=result[name].names)
    return result

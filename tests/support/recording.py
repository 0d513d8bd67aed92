"""Synthetic episodes: a Panda whose joints move and whose cameras see images that differ by frame and by camera.

Nothing here needs the simulator. `make_episode` is a pure function of its arguments.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from demorec.core.config import VideoConfig
from demorec.core.geometry import Pose, look_at
from demorec.episode.episode import (
    Action,
    CameraImages,
    Event,
    Frame,
    JointSample,
    Observation,
    Outcome,
    SuccessCheck,
    frame_time_ns,
)
from demorec.episode.info import EpisodeInfo, Simulation
from demorec.episode.scene import Body, Goal, Physics, RobotPlacement, Scene, SceneCamera, Shape
from demorec.episode.simulated import simulated_cameras, simulated_features
from demorec.mcap import EpisodeWriter
from demorec.robots.panda import PANDA
from demorec.sim.sensors import SENSORS

Codec = Literal["h264", "av1", "jpeg"]
PHASES = ("approach", "descend", "grasp", "lift", "transport", "place", "retreat")
HOME = (0.0, -0.4, 0.0, -2.2, 0.0, 1.8, 0.785)


def make_episode(
    *,
    num_frames: int = 60,
    cameras: Sequence[str] = ("front", "wrist"),
    width: int = 64,
    height: int = 48,
    fps: int = 30,
    physics_hz: int = 240,
    episode_index: int = 0,
    success: bool = True,
    depth: bool = False,
    segmentation: bool = False,
    physics_rate_joints: bool = False,
    seed: int = 0,
) -> tuple[EpisodeInfo, list[Frame], Outcome]:
    """Make an episode in memory: its description, its frames and its outcome.

    `physics_rate_joints` adds joint samples between the frames. Camera "front" is fixed in the world, every other one
    sits on the hand.
    """
    specs = tuple(_camera(name, width, height) for name in cameras)
    simulation = Simulation(
        root_seed=seed,
        task="pick_place",
        robot=PANDA,
        scene=_scene(specs, physics_hz),
        physics_hz=physics_hz,
        behaviour={"speed": 0.8 + 0.01 * episode_index, "approach_height": 0.1},
        config={"task": "pick_place", "seed": seed, "video": {"codec": "h264"}},
        config_digest="0123456789abcdef",
    )
    info = EpisodeInfo(
        episode_index=episode_index,
        instruction="pick up the red cube and place it on the green target",
        robot_name=PANDA.name,
        fps=fps,
        features=simulated_features(simulation, [sensor.feature(PANDA) for sensor in SENSORS]),
        cameras=simulated_cameras(simulation.scene),
        versions={"demorec": "0.1.0", "pybullet": "3.2.7", "numpy": "2.2.6"},
        simulation=simulation,
    )
    substeps = physics_hz // fps
    frames = []
    for index in range(num_frames):
        samples = []
        if physics_rate_joints and index > 0:
            for step in range(1, substeps):
                before, after = frame_time_ns(index - 1, fps), frame_time_ns(index, fps)
                time_ns = before + (after - before) * step // substeps
                q, v, e = _joints(time_ns / 1e9, episode_index)
                samples.append(JointSample(time_ns=time_ns, joint_position=q, joint_velocity=v, joint_effort=e))
        frames.append(
            _frame(index, fps, num_frames, specs, episode_index, depth, segmentation, joint_samples=tuple(samples))
        )
    checks = (
        SuccessCheck(name="distance_to_target", value=0.004 if success else 0.2, limit=0.02, unit="m", passed=success),
    )
    outcome = Outcome(
        success=success,
        checks=checks,
        failure_phase="" if success else "place",
        failure_reason="" if success else "distance_to_target",
        num_frames=num_frames,
        final_state_digest=f"{episode_index:064x}",
    )
    return info, frames, outcome


def frame_number(image: NDArray[np.uint8]) -> int:
    """The frame's number modulo 256, from the bar code at the bottom of its image, encoded or not."""
    side = -(-image.shape[1] // 8)
    blocks = [image[-6:-2, bit * side + 1 : (bit + 1) * side - 1].mean() for bit in range(8)]
    return sum(1 << bit for bit, value in enumerate(blocks) if value > 125)


def write_episode(path: Path, *, video: VideoConfig | None = None, **arguments: object) -> Path:
    info, frames, outcome = make_episode(**arguments)  # type: ignore[arg-type]
    with EpisodeWriter(path, info, video=video) as writer:
        for frame in frames:
            writer.write(frame)
        writer.finish(outcome)
    return path


def _camera(name: str, width: int, height: int) -> SceneCamera:
    if name == "front":
        pose = look_at((1.2, 0.0, 0.8), (0.45, 0.0, 0.1))
        return SceneCamera(name=name, width=width, height=height, fov_y=0.9, mount="world", mount_from_camera=pose)
    pose = Pose(position=np.array([0.06, 0.0, 0.0]))
    return SceneCamera(name=name, width=width, height=height, fov_y=1.2, mount="panda_hand", mount_from_camera=pose)


def _scene(cameras: tuple[SceneCamera, ...], physics_hz: int) -> Scene:
    return Scene(
        robot=RobotPlacement(name="panda", world_from_base=Pose(), joint_position=HOME, gripper_width=0.08),
        bodies=(
            Body(
                name="table",
                role="support",
                shape=Shape(kind="box", size=(0.9, 1.2, 0.04)),
                world_from_body=Pose(position=np.array([0.5, 0.0, -0.02])),
                rgba=(0.8, 0.65, 0.45, 1.0),
            ),
            Body(
                name="cube",
                role="object",
                shape=Shape(kind="box", size=(0.045, 0.045, 0.045)),
                world_from_body=Pose.from_yaw((0.45, -0.1, 0.0225), 0.3),
                mass=0.1,
                rgba=(0.85, 0.1, 0.1, 1.0),
                color_name="red",
                yaw_symmetry=4,
            ),
            Body(
                name="target",
                role="target",
                shape=Shape(kind="box", size=(0.08, 0.08, 0.001)),
                world_from_body=Pose.from_yaw((0.5, 0.15, 0.0005), 0.0),
                rgba=(0.1, 0.7, 0.2, 1.0),
                color_name="green",
                collides=False,
                yaw_symmetry=4,
            ),
        ),
        goals=(Goal(object="cube", onto="target", onto_from_goal=Pose(position=np.array([0.0, 0.0, 0.0225]))),),
        physics=Physics(hz=physics_hz),
        cameras=cameras,
    )


def _joints(seconds: float, episode_index: int) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    n = np.arange(9)
    rate = 0.5 + 0.1 * n
    home = np.array([*HOME, 0.04, 0.04])
    amplitude = np.array([0.3] * 7 + [0.01, 0.01])
    position = home + amplitude * np.sin(rate * seconds + 0.1 * episode_index)
    velocity = amplitude * rate * np.cos(rate * seconds + 0.1 * episode_index)
    effort = 3.0 * np.cos(2 * rate * seconds) + n
    return position, velocity, effort


def _frame(
    index: int,
    fps: int,
    num_frames: int,
    cameras: tuple[SceneCamera, ...],
    episode_index: int,
    depth: bool,
    segmentation: bool,
    *,
    joint_samples: tuple[JointSample, ...],
) -> Frame:
    time_ns = frame_time_ns(index, fps)
    seconds = time_ns / 1e9
    q, v, e = _joints(seconds, episode_index)
    q_next, _, _ = _joints(seconds + 1 / fps, episode_index)
    tcp = Pose.from_yaw((0.45 + 0.05 * math.sin(seconds), 0.1 * seconds / 10, 0.3), 0.2 * seconds)
    tcp_next = Pose.from_yaw((0.45 + 0.05 * math.sin(seconds + 1 / fps), 0.1 * seconds / 10, 0.3), 0.2 * seconds)
    phase = PHASES[min(len(PHASES) - 1, index * len(PHASES) // max(num_frames, 1))]
    action = Action(
        joint_target=q_next[:7].copy(), gripper_target=float(q_next[7:].sum()), base_from_tcp_target=tcp_next
    )
    command = Action(
        joint_target=q_next[:7] + 1e-3 * math.cos(index),
        gripper_target=float(q_next[7:].sum()),
        base_from_tcp_target=tcp_next,
    )
    events = []
    if index == num_frames // 3:
        events.append(Event(name="grasp", message="both fingers touch the cube"))
    if index == num_frames // 2:
        events.append(Event(name="slip", message="the cube moved in the hand", level="warning"))
    return Frame(
        frame_index=index,
        time_ns=time_ns,
        observation=Observation(
            joint_position=q,
            joint_velocity=v,
            joint_effort=e,
            gripper_width=float(q[7:].sum()),
            base_from_tcp=tcp,
            object_poses={"cube": Pose.from_yaw((0.45, -0.1 + 0.01 * seconds, 0.0225 + 0.02 * seconds), 0.3 + seconds)},
            contact_force=max(0.0, 5.0 * math.sin(seconds)),
            sensed={
                sensor.quantity: np.array([math.sin((n + 1) * seconds) - n for n in range(len(sensor.elements(PANDA)))])
                for sensor in SENSORS
            },
        ),
        action=action,
        command=command,
        phase=phase,
        events=tuple(events),
        images={
            camera.name: _images(camera, number, index, tcp, depth, segmentation)
            for number, camera in enumerate(cameras)
        },
        joint_samples=joint_samples,
        is_deliberate_miss=num_frames // 4 <= index < num_frames // 3,
    )


def _images(
    camera: SceneCamera, number: int, index: int, base_from_tcp: Pose, depth: bool, segmentation: bool
) -> CameraImages:
    rows, cols = np.mgrid[0 : camera.height, 0 : camera.width]
    color = np.empty((camera.height, camera.width, 3), dtype=np.uint8)
    color[..., 0] = (rows * 2 + 3 * index) % 256
    color[..., 1] = (cols * 2 + 40 * number) % 256
    color[..., 2] = 60 + 50 * number
    side = max(4, camera.height // 4)
    left = (2 * index + 11 * number) % max(1, camera.width - side)
    square = (slice(camera.height // 2, camera.height // 2 + side), slice(left, left + side))
    color[square] = (220, 40, 30)
    bits = [index >> bit & 1 for bit in range(8)]
    color[-8:] = np.repeat([230 if bit else 20 for bit in bits], -(-camera.width // 8))[: camera.width, None]
    labels = np.full(color.shape[:2], 1, dtype=np.int32)  # body 1: the table
    labels[: camera.height // 4] = -1
    labels[square] = 2  # body 2: the cube
    labels[-3:, -3:] = 0 + ((8 + 1) << 24)  # link 8 of body 0, the robot
    distance = np.where(labels < 0, 0.0, 0.5 + rows / 1000 + 0.001 * index).astype(np.float32)
    if camera.mount == "world":
        world_from_camera = camera.mount_from_camera
    else:
        world_from_camera = base_from_tcp @ camera.mount_from_camera
    return CameraImages(
        color=color,
        depth=distance if depth else None,
        segmentation=labels if segmentation else None,
        world_from_camera=world_from_camera,
    )

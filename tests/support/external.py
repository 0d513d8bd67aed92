"""Synthetic external episodes: a two-jointed arm with a gripper, and two cameras with independent rates.

Nothing here needs a simulator. Frames are unevenly spaced, and each stream has separate timestamps.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from demorec.core.config import VideoConfig
from demorec.episode.episode import Outcome, Sample, SampledFrame
from demorec.episode.info import Camera, EpisodeInfo, Feature, Origin
from demorec.extensions.recorder.sampled_writer import SampledWriter

URDF = """<robot name="two_joints">
 <link name="base"><visual><geometry><box size="0.1 0.1 0.1"/></geometry></visual></link>
 <link name="upper"><visual><geometry><cylinder radius="0.02" length="0.3"/></geometry></visual></link>
 <link name="lower"><visual><geometry><cylinder radius="0.02" length="0.2"/></geometry></visual></link>
 <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/>
  <origin xyz="0 0 0.05"/><axis xyz="0 0 1"/><limit lower="-2" upper="2" effort="1" velocity="3"/></joint>
 <joint name="elbow" type="revolute"><parent link="upper"/><child link="lower"/>
  <origin xyz="0.3 0 0"/><axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="1" velocity="3"/></joint>
</robot>
"""
STATE = Feature(
    name="observation.state",
    dtype="float32",
    names=("shoulder.pos", "elbow.pos", "gripper.pos"),
    units=("rad", "rad", ""),
    joints=("shoulder", "elbow", ""),
)
ACTION = Feature(name="action", names=("shoulder.pos", "elbow.pos", "gripper.pos"), joints=STATE.joints)
FORCE = Feature(name="observation.force", names=("x", "y", "z"), units=("N", "N", "N"))
TOP = Camera(name="top", width=64, height=48, intrinsics=(60.0, 0.0, 32.0, 0.0, 60.0, 24.0, 0.0, 0.0, 1.0))
WRIST = Camera(name="wrist", width=32, height=32)
START_NS = 1_700_000_000_123_456_789


@dataclass(frozen=True, kw_only=True, eq=False)
class Episode:
    """An episode to be written.

    Attributes:
        info, frames, outcome: Arguments of the writer.
        images: Camera -> (stamp, pixels) in order.
    """

    info: EpisodeInfo
    frames: list[SampledFrame]
    images: dict[str, list[tuple[int, NDArray[np.uint8]]]]
    outcome: Outcome


def make_external(
    *,
    num_frames: int = 45,
    cameras: tuple[Camera, ...] = (TOP, WRIST),
    urdf: str = URDF,
    episode_index: int = 0,
    success: bool | None = True,
) -> Episode:
    """Make an episode: frames 20 to 45 ms apart; the camera `wrist` has an image every second frame, which is repeated
    once.
    """
    random = np.random.default_rng(episode_index)
    info = EpisodeInfo(
        episode_index=episode_index,
        instruction="stack the cups",
        robot_name="two_joints",
        urdf=urdf,
        fps=30,
        features=(STATE, ACTION, FORCE),
        cameras=cameras,
        origin=Origin(),
        versions={"demorec": "0"},
    )
    times = START_NS + np.cumsum(random.integers(20_000_000, 45_000_000, num_frames))
    images: dict[str, list[tuple[int, NDArray[np.uint8]]]] = {camera.name: [] for camera in cameras}
    frames = []
    phases = random.uniform(-np.pi, np.pi, (2, 3))  # joints that swing, no faster than motors
    for index, time_ns in enumerate(times.tolist()):
        held = {}
        for camera in cameras:
            if camera.name == "top" or index % 2 == 1:
                pixels = _image(camera, index)
                images[camera.name].append((time_ns - 7_000_000, pixels))
            if images[camera.name]:  # the wrist camera has none at the first frame
                held[camera.name] = len(images[camera.name]) - 1
        frames.append(
            SampledFrame(
                time_ns=time_ns,
                samples={
                    STATE.name: Sample(
                        stamp_ns=time_ns - 1_000_000, vector=np.sin(0.05 * index + phases[0]).astype(np.float32)
                    ),
                    ACTION.name: Sample(stamp_ns=time_ns, vector=np.sin(0.05 * index + phases[1])),
                    FORCE.name: Sample(stamp_ns=time_ns - 12_345_678, vector=random.normal(size=3)),
                },
                images=held,
            )
        )
    outcome = Outcome(success=success, num_frames=num_frames, drops={"wrist": 2})
    return Episode(info=info, frames=frames, images=images, outcome=outcome)


def _image(camera: Camera, index: int) -> NDArray[np.uint8]:
    """A ramp whose brightness identifies the frame."""
    pixels = np.zeros((camera.height, camera.width, 3), dtype=np.uint8)
    pixels[..., 0] = np.linspace(0, 200, camera.width).astype(np.uint8)
    pixels[..., 1] = 5 * (index % 50)
    pixels[: camera.height // 2, :, 2] = 255 if camera.name == "top" else 0
    return pixels


def write_images_and_frames(writer: SampledWriter, episode: Episode) -> None:
    """Write everything except the end."""
    given = dict.fromkeys(episode.images, 0)
    for frame in episode.frames:
        for name, number in frame.images.items():
            while given[name] <= number:
                stamp_ns, pixels = episode.images[name][given[name]]
                assert writer.image(name, stamp_ns, pixels) == given[name]
                given[name] += 1
        writer.write(frame)


def write_external(path: Path, episode: Episode | None = None, *, video: VideoConfig | None = None) -> Path:
    episode = episode or make_external()
    with SampledWriter(path, episode.info, video=video) as writer:
        write_images_and_frames(writer, episode)
        writer.finish(episode.outcome)
    return path

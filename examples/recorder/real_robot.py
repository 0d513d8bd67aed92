"""Record a real robot's own control loop: python examples/recorder/real_robot.py runs/real_robot.

`MyArm` and `MyCamera` stand in for the drivers of your arm and camera. The loop reads the sensors, sends a command and
passes everything to the recorder, which never blocks it: another thread encodes the images.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from demorec import Recorder

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
FPS = 30


class MyArm:
    """An arm whose joints follow their targets."""

    def __init__(self) -> None:
        self._position = np.zeros(len(JOINTS))

    def read(self) -> NDArray[np.float64]:
        """Read the joint positions, (6,) rad."""
        return self._position.copy()

    def send(self, target: NDArray[np.float64]) -> None:
        """Send joint targets, (6,) rad."""
        self._position += 0.5 * (target - self._position)


class MyCamera:
    """A camera that has a new image now and then, with its time of capture."""

    def __init__(self) -> None:
        self._count = 0

    def latest(self) -> tuple[NDArray[np.uint8], int]:
        """(480, 640, 3) RGB and its timestamp in nanoseconds, in the loop's clock."""
        self._count += 1
        image = np.zeros((480, 640, 3), dtype=np.uint8)
        image[:, (4 * self._count) % 600 :][:, :40] = (200, 120, 0)
        return image, time.monotonic_ns()


def every(seconds: float, count: int) -> Iterator[int]:
    """Numbers, one at each interval of the given length."""
    start = time.monotonic()
    for number in range(count):
        time.sleep(max(0.0, start + number * seconds - time.monotonic()))
        yield number


def main(folder: str, num_episodes: int = 2, seconds: float = 2.0) -> None:
    """Record some episodes; Ctrl-C ends the current one, and keeps it."""
    arm, camera = MyArm(), MyCamera()
    with Recorder(
        folder, robot=JOINTS, cameras={"top": (480, 640)}, fps=FPS, task="wave the gripper", clock=time.monotonic_ns
    ) as recorder:
        for _ in range(num_episodes):
            with recorder.episode() as episode:
                for step in every(1 / FPS, round(seconds * FPS)):
                    position = arm.read()
                    target = np.full(len(JOINTS), np.sin(step / 10))
                    arm.send(target)
                    images = {"top": camera.latest()} if step % 3 < 2 else {}  # sometimes there is none
                    episode.write(position, target, images)
                episode.success = True
        print(f"{recorder.num_episodes} episodes in {recorder.path}")


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "runs/real_robot")

"""Record your own PyBullet simulation: python examples/recorder/own_simulation.py runs/kuka.

demorec's simulator is not used: the program loads a URDF from pybullet_data, steps its own world, takes images with two
cameras and passes everything to the recorder. The URDF is included, so that a viewer shows the arm.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
import pybullet
import pybullet_data
from numpy.typing import NDArray

from demorec import Recorder
from demorec.api import Camera

URDF = Path(pybullet_data.getDataPath()) / "kuka_iiwa" / "model.urdf"
FPS, PHYSICS_HZ = 30, 240
SIDE = 128
FOV_DEGREES = 60.0
FOCAL = SIDE / 2 / math.tan(math.radians(FOV_DEGREES) / 2)
INTRINSICS = (FOCAL, 0.0, SIDE / 2, 0.0, FOCAL, SIDE / 2, 0.0, 0.0, 1.0)
MAX_SPEED = 1.5
"""Maximum speed of each joint, rad/s; without it PyBullet's motors jump to their targets."""
EYES = {"front": (1.5, 0.0, 0.9), "side": (0.0, 1.5, 0.9)}


def take_image(client: int, eye: tuple[float, float, float]) -> NDArray[np.uint8]:
    """(H, W, 3) RGB of the arm, seen from `eye` (world frame, metres)."""
    view = pybullet.computeViewMatrix(eye, (0.0, 0.0, 0.5), (0.0, 0.0, 1.0), physicsClientId=client)
    projection = pybullet.computeProjectionMatrixFOV(FOV_DEGREES, 1.0, 0.1, 5.0, physicsClientId=client)
    _, _, rgba, _, _ = pybullet.getCameraImage(
        SIDE, SIDE, view, projection, renderer=pybullet.ER_TINY_RENDERER, physicsClientId=client
    )
    return np.ascontiguousarray(np.asarray(rgba, dtype=np.uint8).reshape(SIDE, SIDE, 4)[..., :3])


def main(folder: str, num_episodes: int = 2, num_frames: int = 45) -> None:
    """Record an arm that moves to random targets."""
    random = np.random.default_rng(0)
    client = pybullet.connect(pybullet.DIRECT)
    try:
        arm = pybullet.loadURDF(str(URDF), useFixedBase=True, physicsClientId=client)
        joints = list(range(pybullet.getNumJoints(arm, physicsClientId=client)))
        cameras = {name: Camera(name=name, width=SIDE, height=SIDE, intrinsics=INTRINSICS) for name in EYES}
        # A simulator can wait for the encoder; a robot cannot.
        with Recorder(folder, robot=URDF, cameras=cameras, fps=FPS, task="reach out", when_full="wait") as recorder:
            for _ in range(num_episodes):
                goal = random.uniform(-0.8, 0.8, len(joints))
                with recorder.episode() as episode:
                    for frame in range(num_frames):
                        states = pybullet.getJointStates(arm, joints, physicsClientId=client)
                        position = np.array([state[0] for state in states])
                        for joint, target in zip(joints, goal.tolist(), strict=True):
                            pybullet.setJointMotorControl2(
                                arm,
                                joint,
                                pybullet.POSITION_CONTROL,
                                targetPosition=target,
                                maxVelocity=MAX_SPEED,
                                physicsClientId=client,
                            )
                        images = {name: take_image(client, eye) for name, eye in EYES.items()}
                        # Simulated time is exact; wall time is meaningless here.
                        episode.write(position, goal, images, time_ns=frame * 1_000_000_000 // FPS)
                        for _ in range(PHYSICS_HZ // FPS):
                            pybullet.stepSimulation(physicsClientId=client)
                    episode.success = bool(np.abs(position - goal).max() < 0.1)
            print(f"{recorder.num_episodes} episodes in {recorder.path}")
    finally:
        pybullet.disconnect(physicsClientId=client)


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "runs/mine")

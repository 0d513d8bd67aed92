"""HDF5 files of other projects, written by h5py alone in the layouts that robomimic's and ALOHA's sources document."""

from __future__ import annotations

import io
import json
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray
from PIL import Image

WIDTH, HEIGHT = 64, 48
ROBOMIMIC_LENGTHS = (7, 5, 6)
ALOHA_CAMERAS = ("cam_high", "cam_left_wrist")


def images(count: int, seed: int) -> NDArray[np.uint8]:
    """(T, H, W, 3): a ramp whose brightness identifies the row, and a red corner that reveals exchanged colours."""
    shown = np.zeros((count, HEIGHT, WIDTH, 3), np.uint8)
    shown[..., 1] = np.linspace(0, 200, WIDTH).astype(np.uint8)
    shown[..., 2] = (20 * np.arange(count) + seed).astype(np.uint8)[:, np.newaxis, np.newaxis]
    shown[:, : HEIGHT // 2, : WIDTH // 2, 0] = 255
    return shown


def write_robomimic(path: Path, *, compression: str | None = None) -> Path:
    """Write a processed robosuite dataset: data/demo_N with actions, rewards, dones, states, obs; masks; env_args.

    demo_10 takes the place of demo_2, so that names and numbers sort differently.
    """
    rng = np.random.default_rng(1)
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        kwargs = {"robots": ["Panda"], "camera_names": ["agentview"], "control_freq": 20.0}
        described = {"env_name": "Lift", "type": 1, "env_kwargs": kwargs}
        data.attrs["env_args"] = json.dumps(described)
        data.attrs["total"] = sum(ROBOMIMIC_LENGTHS)
        for name, count in zip(("demo_0", "demo_1", "demo_10"), ROBOMIMIC_LENGTHS, strict=True):
            demo = data.create_group(name)
            demo.attrs["num_samples"] = count
            demo.attrs["model_file"] = "<mujoco model='base'></mujoco>"
            demo["actions"] = rng.uniform(-1, 1, (count, 7))
            demo["states"] = rng.normal(size=(count, 32))
            demo["rewards"] = (np.arange(count) == count - 1).astype(np.float64)
            demo["dones"] = (np.arange(count) == count - 1).astype(np.int64)
            for group in ("obs", "next_obs"):
                observed = demo.create_group(group)
                for key, width in (
                    ("robot0_joint_pos", 7), ("robot0_joint_vel", 7), ("robot0_gripper_qpos", 2),
                    ("robot0_gripper_qvel", 2), ("robot0_eef_pos", 3), ("robot0_eef_quat", 4), ("object", 10),
                ):  # fmt: skip
                    observed[key] = rng.normal(size=(count, width))
                shown = images(count, seed=len(name))
                observed.create_dataset("agentview_image", data=shown, compression=compression)
                observed.create_dataset("robot0_eye_in_hand_image", data=shown[:, :, ::-1], compression=compression)
        file["mask/train"] = np.array(["demo_0", "demo_10"], dtype="S")
        file["mask/valid"] = np.array(["demo_1"], dtype="S")
    return path


def jpeg(image: NDArray[np.uint8], quality: int) -> bytes:
    stored = io.BytesIO()
    Image.fromarray(image).save(stored, "JPEG", quality=quality)
    return stored.getvalue()


def write_aloha(path: Path, *, count: int = 8, is_compressed: bool = False, seed: int = 0) -> Path:
    """Write an ALOHA episode: qpos, qvel, images, action; mobile ALOHA's base_action, and JPEG images if compressed."""
    rng = np.random.default_rng(seed)
    path.parent.mkdir(exist_ok=True)
    with h5py.File(path, "w", rdcc_nbytes=2 << 20) as file:
        file.attrs["sim"] = False
        observations = file.create_group("observations")
        group = observations.create_group("images")
        if is_compressed:
            file.attrs["compress"] = True
            coded = {
                camera: [jpeg(image, 60 + 5 * number) for number, image in enumerate(images(count, 10 * k))]
                for k, camera in enumerate(ALOHA_CAMERAS)
            }
            width = max(len(data) for row in coded.values() for data in row)
            for camera, row in coded.items():
                stored = group.create_dataset(camera, (count, width), "uint8", chunks=(1, width))
                for number, data in enumerate(row):
                    stored[number] = np.frombuffer(data.ljust(width, b"\0"), np.uint8)
            # As ALOHA's recorders write it: float32, cameras in the order of a separate list, which differs from the
            # file's.
            lengths = [[len(data) for data in coded[camera]] for camera in reversed(ALOHA_CAMERAS)]
            file.create_dataset("compress_len", data=np.array(lengths), dtype="f4")
        else:
            for k, camera in enumerate(ALOHA_CAMERAS):
                shape = (count, HEIGHT, WIDTH, 3)
                group.create_dataset(camera, shape, "uint8", chunks=(1, *shape[1:]))[...] = images(count, 10 * k)
        for group, name, width in ((observations, "qpos", 14), (observations, "qvel", 14), (file, "action", 14)):
            group.create_dataset(name, (count, width), "f4")[...] = rng.normal(size=(count, width))
        if is_compressed:
            file.create_dataset("base_action", (count, 2), "f4")[...] = rng.normal(size=(count, 2))
    return path


def write_isaac(path: Path, *, robot: str = "robot") -> Path:
    """Write a file like Isaac Lab's recorder: joint_pos relative to the default pose, quaternions with w first."""
    rng, count, joints = np.random.default_rng(2), 6, 9
    default = rng.normal(size=joints)
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs["env_args"] = json.dumps({"env_name": "Isaac-Stack-Cube-Franka-v0", "type": 2})
        for name in ("demo_0", "demo_1"):
            demo = data.create_group(name)
            absolute = rng.normal(size=(count, joints)).astype(np.float32)
            demo["actions"] = rng.uniform(-1, 1, (count, 7)).astype(np.float32)
            demo["obs/joint_pos"] = absolute - default.astype(np.float32)
            demo["obs/joint_vel"] = rng.normal(size=(count, joints)).astype(np.float32)
            demo["obs/eef_pos"] = rng.normal(size=(count, 3)).astype(np.float32)
            quaternions = rng.normal(size=(count, 4))
            demo["obs/eef_quat"] = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
            demo[f"states/articulation/{robot}/joint_position"] = absolute
            demo[f"states/articulation/{robot}/root_pose"] = rng.normal(size=(count, 7)).astype(np.float32)
    return path

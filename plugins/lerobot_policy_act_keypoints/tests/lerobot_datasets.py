"""Datasets that LeRobot itself writes, and a comparison of two readers' items."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

CAMERA, DEPTH = "observation.images.top", "observation.images.top_depth"
SMALL_ACT: dict[str, Any] = {
    "type": "act",
    "device": "cpu",
    "push_to_hub": False,
    "dim_model": 16,
    "n_heads": 2,
    "dim_feedforward": 32,
    "n_encoder_layers": 1,
    "use_vae": False,
    "dropout": 0.0,  # LeRobot does not restore the random state of a stopped training
    "chunk_size": 8,
    "n_action_steps": 4,
    "pretrained_backbone_weights": None,
}
"""Settings of a policy that trains in no time."""
SIZE = 64
"""Side of the images: the minimum of LeRobot's AV1 encoder."""


def write_by_lerobot(
    root: Path, lengths: Sequence[int], *, stored_as: str = "video", depth: bool = False, **arguments: Any
) -> Path:
    """Write a dataset with a feature of every type, two instructions, and small, therefore several, files.

    Args:
        root: A folder that does not exist yet.
        lengths: Frames of each episode.
        stored_as: "video" or "image": how images are kept.
        depth: Whether there is a depth camera, too.
        arguments: Further arguments of `LeRobotDataset.create`.
    """
    with _ordinary_scheduling():
        return _write(root, lengths, stored_as=stored_as, depth=depth, **arguments)


def _write(root: Path, lengths: Sequence[int], *, stored_as: str, depth: bool, **arguments: Any) -> Path:
    from lerobot.datasets import LeRobotDataset

    axes = ["height", "width", "channels"]
    features: dict[str, dict[str, Any]] = {
        "observation.state": {"dtype": "float32", "shape": (5,), "names": None},
        "observation.single": {"dtype": "float64", "shape": (1,), "names": None},
        "observation.grid": {"dtype": "float32", "shape": (2, 3), "names": None},
        "observation.counts": {"dtype": "int64", "shape": (3,), "names": None},
        "observation.touch": {"dtype": "bool", "shape": (1,), "names": None},
        "note": {"dtype": "string", "shape": (1,), "names": None},
        CAMERA: {"dtype": stored_as, "shape": (SIZE, SIZE, 3), "names": axes},
        "action": {"dtype": "float32", "shape": (4,), "names": None},
    }
    if depth:
        about = {"is_depth_map": True, "depth_unit": "m"}
        features[DEPTH] = {"dtype": stored_as, "shape": (SIZE, SIZE, 1), "names": axes, "info": about}
    files: dict[str, Any] = {"video_files_size_in_mb": 0.001, "data_files_size_in_mb": 0.004}
    dataset = LeRobotDataset.create(
        "local/test", 30, features, root=root, use_videos=stored_as == "video", **{**files, **arguments}
    )
    rng = np.random.default_rng(0)
    for episode, length in enumerate(lengths):
        for t in range(length):
            frame: dict[str, Any] = {
                "observation.state": rng.normal(size=5).astype(np.float32),
                "observation.single": rng.normal(size=1),
                "observation.grid": rng.normal(size=(2, 3)).astype(np.float32),
                "observation.counts": rng.integers(-9, 1 << 40, 3),
                "observation.touch": np.array([t % 3 == 0]),
                "note": f"frame {t} of {episode}",
                CAMERA: _image(episode, t),
                "action": rng.normal(size=4).astype(np.float32),
                "task": ("push it", "pull it")[episode % 2],
            }
            if depth:
                frame[DEPTH] = rng.uniform(0.2, 4, (SIZE, SIZE, 1)).astype(np.float32)
            dataset.add_frame(frame)
        dataset.save_episode()
    dataset.finalize()
    return root


def _image(episode: int, t: int) -> NDArray[np.uint8]:
    """A block that moves over a slope: every frame differs from the others."""
    rows, columns = np.mgrid[0:SIZE, 0:SIZE]
    image = np.stack([rows * 2 + 40, columns * 3, np.full_like(rows, 30 * episode % 256)], axis=-1).astype(np.uint8)
    image[3 * t % 48 : 3 * t % 48 + 16, 5 * t % 48 : 5 * t % 48 + 16] = (250, 20 + 4 * t, 200)
    return image


@contextmanager
def _ordinary_scheduling() -> Iterator[None]:
    """Undo the real-time priority that SVT-AV1, run by root, gives the threads of this process."""
    try:
        yield
    finally:
        for thread in Path("/proc/self/task").iterdir():
            with suppress(ProcessLookupError):
                os.sched_setscheduler(int(thread.name), os.SCHED_OTHER, os.sched_param(0))


TCP_NAMES = ["tcp.x", "tcp.y", "tcp.z", "tcp.qx", "tcp.qy", "tcp.qz", "tcp.qw"]
DELTA_NAMES = ["tcp.dx", "tcp.dy", "tcp.dz", "tcp.drx", "tcp.dry", "tcp.drz"]
WIDTH, HEIGHT, PIXELS_PER_METRE = 64, 48, 100
REACH, CARRY, RETREAT = 8, 8, 2
"""Frames of each part of a demonstration: to the object, to its goal, away."""
OPEN_M = 0.08


def write_demonstrations(root: Path, count: int, *, names_tcp: bool = True) -> Path:
    """Write demonstrations: a hand moves straight to a red square, closes, brings it to a green one and opens.

    Args:
        root: A folder that does not exist yet.
        count: Number of episodes. The instructions of even and odd ones differ.
        names_tcp: Name the elements of the TCP's pose.
    """
    from lerobot.configs import RGBEncoderConfig
    from lerobot.datasets import LeRobotDataset

    image = {"dtype": "video", "shape": (HEIGHT, WIDTH, 3), "names": ["height", "width", "channels"]}
    features = {
        "observation.state": {"dtype": "float32", "shape": (4,), "names": ["x", "y", "z", "gripper.width"]},
        "observation.ee_pose": {"dtype": "float32", "shape": (7,), "names": TCP_NAMES if names_tcp else None},
        "observation.images.top": image,
        "action": {"dtype": "float32", "shape": (7,), "names": [*DELTA_NAMES, "gripper.width"]},
    }
    encoder = RGBEncoderConfig(vcodec="h264", g=6)
    dataset = LeRobotDataset.create("local/test", 10, features, root=root, use_videos=True, rgb_encoder=encoder)
    rng = np.random.default_rng(0)
    for number in range(count):
        for frame in _demonstration(rng):
            task = ("bring red to green", "put the red square onto the green one")[number % 2]
            dataset.add_frame({**frame, "task": task})
        dataset.save_episode()
    dataset.finalize()
    return root


def _demonstration(rng: np.random.Generator) -> Iterator[dict[str, Any]]:
    start, object_place, goal = rng.uniform((0.05, 0.05, 0.1), (0.59, 0.43, 0.1), (3, 3))
    parts = [(start, object_place, REACH), (object_place, goal, CARRY), (goal, start, RETREAT)]
    tcp = np.concatenate([np.linspace(a, b, steps, endpoint=False) for a, b, steps in parts])
    displacement = np.diff(tcp, axis=0, append=tcp[-1:])
    for t, position in enumerate(tcp):
        is_closed = REACH <= t < REACH + CARRY
        red = object_place if t < REACH else position if is_closed else goal
        width = 0.0 if is_closed else OPEN_M
        yield {
            "observation.state": np.array([*position, width], np.float32),
            "observation.ee_pose": np.array([*position, 1, 0, 0, 0], np.float32),  # the hand points down
            "observation.images.top": _top_view([(goal, (40, 200, 60)), (red, (230, 30, 30)), (position, (250,) * 3)]),
            "action": np.array([*displacement[t], 0, 0, 0, width], np.float32),
        }


def _top_view(squares: Sequence[tuple[NDArray[np.float64], tuple[int, ...]]]) -> NDArray[np.uint8]:
    """The table from above: a square of 5 cm at each position (x, y in metres), later ones above earlier ones."""
    image = np.full((HEIGHT, WIDTH, 3), 60, np.uint8)
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH]
    for (x, y, _), color in squares:
        distance = np.maximum(abs(columns / PIXELS_PER_METRE - x), abs(rows / PIXELS_PER_METRE - y))
        image[distance < 0.025] = color
    return image


def assert_same_item(found: Mapping[str, Any], wanted: Mapping[str, Any]) -> None:
    """The same keys in the same order, types, shapes and bits."""
    import torch

    assert list(found) == list(wanted)
    for key, value in wanted.items():
        assert type(found[key]) is type(value), key
        if isinstance(value, torch.Tensor):
            assert (found[key].dtype, found[key].shape) == (value.dtype, value.shape), key
            assert found[key].numpy().tobytes() == value.numpy().tobytes(), key
        else:
            assert found[key] == value, key

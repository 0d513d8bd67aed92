"""Datasets written by LeRobot, and a comparison of episodes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

TOP = "observation.images.top"


def write_with_lerobot(root: Path, *, video: bool = True, episodes: int = 6, **arguments: Any) -> Path:
    """Write episodes of 12, 13, ... frames at 10 Hz: a square that moves, except at both ends, and two alternating
    tasks.
    """
    from lerobot.datasets import LeRobotDataset

    rng = np.random.default_rng(0)
    vector = {"dtype": "float32", "shape": (3,), "names": ["x", "y", "z"]}
    camera = {"dtype": "video" if video else "image", "shape": (64, 96, 3), "names": ["height", "width", "channels"]}
    features = {"observation.state": vector, "action": vector, TOP: camera}
    dataset = LeRobotDataset.create("local/x", fps=10, features=features, root=root, use_videos=video, **arguments)
    for episode in range(episodes):
        length = 12 + episode
        for t in range(length):
            background = (episode * 20 + t * 3) % 255
            contrast = rng.integers(60, 125, 3)  # at least this: an image in one grey is blank
            image = np.full((64, 96, 3), background, np.uint8)
            image[10:30, 5 + t : 25 + t] = background + (contrast if background < 128 else -contrast)
            frame = {
                "observation.state": rng.normal(size=3).astype(np.float32) * (3 < t < length - 4),
                "action": rng.normal(size=3).astype(np.float32),
                TOP: image,
                "task": "put it here" if episode % 2 else "put it there",
            }
            dataset.add_frame(frame)
        dataset.save_episode()
    dataset.finalize()
    return root


def items(root: Path, backend: str = "pyav") -> list[list[dict[str, Any]]]:
    """Frames of every episode as LeRobot reads them, without counters: numbers, decoded images, task."""
    from lerobot.datasets import LeRobotDataset

    dataset = LeRobotDataset("local/test", root=root, video_backend=backend, return_uint8=True)
    found: list[list[dict[str, Any]]] = []
    for index in range(len(dataset)):
        item = {name: np.asarray(value) for name, value in dataset[index].items()}
        number, frame = int(item.pop("episode_index")), int(item.pop("frame_index"))
        assert int(item.pop("index")) == index
        item.pop("task_index")
        if frame == 0:
            found.append([])
        assert (len(found) - 1, len(found[-1])) == (number, frame)
        found[-1].append(item)
    return found


def same(a: list[dict[str, Any]], b: list[dict[str, Any]], *, but: tuple[str, ...] = ()) -> bool:
    """Whether two episodes, as returned by `items`, are equal bit for bit."""
    return len(a) == len(b) and all(
        set(x) - set(but) == set(y) - set(but)
        and all(x[name].dtype == y[name].dtype and np.array_equal(x[name], y[name]) for name in set(x) - set(but))
        for x, y in zip(a, b, strict=True)
    )

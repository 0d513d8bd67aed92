"""Datasets that LeRobot itself writes, and the comparison of two readers' items."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.mcap.video import ordinary_scheduling

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
    "dropout": 0.0,  # LeRobot does not take its random numbers up again where they were
    "chunk_size": 8,
    "n_action_steps": 4,
    "pretrained_backbone_weights": None,
}
"""Settings of a policy whose training takes no time."""
SIZE = 64
"""Of the images: the least that LeRobot's AV1 encoder takes."""


def write_by_lerobot(
    root: Path, lengths: Sequence[int], *, stored_as: str = "video", depth: bool = False, **arguments: Any
) -> Path:
    """A dataset with a feature of every type, two instructions, and small files, so that there are several.

    Args:
        root: A folder that does not exist yet.
        lengths: Frames of each episode.
        stored_as: "video" or "image": how images are kept.
        depth: Whether there is a depth camera, too.
        arguments: Of `LeRobotDataset.create`.
    """
    with ordinary_scheduling():  # module fixtures run outside of that of every test
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

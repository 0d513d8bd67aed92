"""One number for the content of a dataset: the same whatever the files' sizes, their compression or their number.

An episode's digest covers its task, its numbers and the coded pictures as they lie in the mp4 file; the digest of
the dataset covers fps, robot, features and the episodes in order. Positions in the dataset (`index`,
`episode_index`, `task_index`) are left out, so that an episode keeps its digest wherever it is put.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.datasets.lerobot.layout import DatasetInfo

_POSITIONS = frozenset(("index", "episode_index", "task_index"))


def episode_digest(task: str, columns: Mapping[str, NDArray[Any]], videos: Mapping[str, str]) -> str:
    """SHA-256 (hex) of one episode.

    Args:
        task: Instruction.
        columns: Feature -> (T,) or (T, D); the positions may be among them.
        videos: Camera feature -> SHA-256 (hex) of its pictures' bytes one after the other.
    """
    result = hashlib.sha256(json.dumps(task).encode())
    for name in sorted(columns):
        if name not in _POSITIONS:
            values = np.ascontiguousarray(columns[name])
            flat = values.reshape(len(values), -1)
            result.update(f"{name} {values.dtype.str} {flat.shape}".encode())
            result.update(flat.tobytes())
    for name in sorted(videos):
        result.update(f"{name} {videos[name]}".encode())
    return result.hexdigest()


def combined_digest(info: DatasetInfo, episodes: Iterable[str]) -> str:
    """SHA-256 (hex) of a dataset, from the digests of its episodes in order."""
    features = {name: [item.dtype, list(item.shape), item.names] for name, item in sorted(info.features.items())}
    result = hashlib.sha256(json.dumps([info.fps, info.robot_type, features]).encode())
    for episode in episodes:
        result.update(episode.encode())
    return result.hexdigest()

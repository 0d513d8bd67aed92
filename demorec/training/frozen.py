"""An encoder of pictures that is not trained: every picture goes through it once."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from demorec.errors import ConfigError

_TOGETHER = 32
"""Pictures that are encoded at once. Always as many (with empty ones), so that what comes out of a picture does not
depend, in its last bits, on how many others are new."""
_FEATURES = "feature_map"


def freeze_encoder(policy: Any, *, num_frames: int, limit_bytes: int) -> None:
    """Keep an ACT policy's encoder of pictures as it is, and keep what it made of the pictures of each frame.

    Args:
        policy: Of LeRobot; its batches have the key "index", as those of a dataset do.
        num_frames: Of the dataset, more than every index.
        limit_bytes: Of what is kept; the rest is encoded each time.

    Raises:
        ConfigError: The policy is no ACT with pictures.
    """
    if policy.config.type != "act" or not policy.config.image_features:
        raise ConfigError("--freeze-encoder is for ACT policies with pictures (--policy.type=act).")
    backbone = policy.model.backbone
    backbone.requires_grad_(False)
    if not limit_bytes:
        return
    memory = _Memory(backbone.forward, num_frames, len(policy.config.image_features), limit_bytes)
    original = policy.forward

    def forward(batch: dict[str, Any], *args: Any, **kwargs: Any) -> Any:
        memory.begin(batch.get("index"))
        try:
            return original(batch, *args, **kwargs)
        finally:
            memory.begin(None)

    policy.forward = forward
    backbone.forward = memory.encode  # of this instance: its parameters keep their names in checkpoints


class _Memory:
    """What an encoder made of the frames of each camera; ACT encodes one camera after the other."""

    def __init__(self, encode: Any, num_frames: int, num_cameras: int, limit_bytes: int) -> None:
        self._encode_all = encode
        self._places = [np.full(num_frames, -1, np.int64) for _ in range(num_cameras)]
        self._limit = limit_bytes // num_cameras
        self._kept: list[NDArray[np.float32] | None] = [None] * num_cameras
        self._num_kept = [0] * num_cameras
        self._index: NDArray[np.int64] | None = None
        self._camera = 0

    def begin(self, index: torch.Tensor | None) -> None:
        """The frames (B,) that are encoded next, camera by camera; None: those of no dataset."""
        self._index = None if index is None else index.reshape(-1).cpu().numpy().astype(np.int64)
        self._camera = 0

    def encode(self, pictures: torch.Tensor) -> dict[str, torch.Tensor]:
        """As the encoder does: (B, 3, H, W) to the map (B, C, h, w) by its name."""
        if self._index is None:
            found: dict[str, torch.Tensor] = self._encode_all(pictures)
            return found
        camera, self._camera = self._camera, self._camera + 1
        places = self._places[camera][self._index]
        new = np.flatnonzero(places < 0)
        made = self._encode(pictures[torch.from_numpy(new)]) if len(new) else None
        kept = self._kept[camera]
        if kept is None:
            assert made is not None
            row = made[0]
            room = min(len(self._places[camera]), self._limit // row.nbytes)
            kept = self._kept[camera] = np.empty((room, *row.shape), np.float32)  # memory is taken as it is filled
        maps = np.empty((len(places), *kept.shape[1:]), np.float32)
        maps[places >= 0] = kept[places[places >= 0]]
        if made is not None:
            maps[new] = made
            self._keep(camera, kept, self._index[new], made)
        return {_FEATURES: torch.from_numpy(maps).to(pictures.device)}

    def _keep(
        self, camera: int, kept: NDArray[np.float32], index: NDArray[np.int64], made: NDArray[np.float32]
    ) -> None:
        once, first = np.unique(index, return_index=True)
        room = min(len(once), len(kept) - self._num_kept[camera])
        places = np.arange(room) + self._num_kept[camera]
        kept[places] = made[first[:room]]
        self._places[camera][once[:room]] = places
        self._num_kept[camera] += room

    def _encode(self, pictures: torch.Tensor) -> NDArray[np.float32]:
        parts = []
        with torch.no_grad():
            for start in range(0, len(pictures), _TOGETHER):
                part = pictures[start : start + _TOGETHER]
                empty = part.new_zeros((_TOGETHER - len(part), *part.shape[1:]))
                maps = self._encode_all(torch.cat([part, empty]))[_FEATURES]
                parts.append(maps[: len(part)].float().cpu().numpy())
        return np.concatenate(parts)

"""An encoder of pictures that is not trained: every picture goes through it once."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from demorec.core.errors import ConfigError

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
    backbone.to(memory_format=torch.channels_last)  # 1.4 times as fast on a CPU
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
    """What an encoder made of the frames of each camera, as ACT takes it; it encodes one camera after the other."""

    def __init__(self, encode: Any, num_frames: int, num_cameras: int, limit_bytes: int) -> None:
        self._encode_all = encode
        self._places = [torch.full((num_frames,), -1) for _ in range(num_cameras)]
        self._limit = limit_bytes // num_cameras
        self._kept: list[torch.Tensor | None] = [None] * num_cameras
        self._num_kept = [0] * num_cameras
        self._index: torch.Tensor | None = None
        self._camera = 0

    def begin(self, index: torch.Tensor | None) -> None:
        """The frames (B,) that are encoded next, camera by camera; None: those of no dataset."""
        self._index = None if index is None else index.reshape(-1).cpu()
        self._camera = 0

    def encode(self, pictures: torch.Tensor) -> dict[str, torch.Tensor]:
        """As the encoder does: (B, 3, H, W) to the map (B, C, h, w) by its name."""
        if self._index is None:
            found: dict[str, torch.Tensor] = self._encode_all(pictures)
            return found
        camera, self._camera = self._camera, self._camera + 1
        places = self._places[camera][self._index]
        is_new = places < 0
        made = self._encode(pictures[is_new.to(pictures.device)]) if is_new.any() else None
        kept = self._kept[camera]
        if kept is None:
            assert made is not None
            room = min(len(self._places[camera]), self._limit // made[0].nbytes)
            kept = made.new_empty((room, *made.shape[1:]))  # memory is taken as it is filled
            self._kept[camera] = kept
        maps = kept.new_empty((len(places), *kept.shape[1:]))
        maps[~is_new] = kept[places[~is_new]]
        if made is not None:
            maps[is_new] = made
            self._keep(camera, kept, self._index[is_new], made)
        return {_FEATURES: maps.to(pictures.device)}

    def _keep(self, camera: int, kept: torch.Tensor, index: torch.Tensor, made: torch.Tensor) -> None:
        once, first = np.unique(index.numpy(), return_index=True)
        room = min(len(once), len(kept) - self._num_kept[camera])
        places = torch.arange(room) + self._num_kept[camera]
        kept[places] = made[torch.from_numpy(first[:room])]
        self._places[camera][torch.from_numpy(once[:room])] = places
        self._num_kept[camera] += room

    def _encode(self, pictures: torch.Tensor) -> torch.Tensor:
        parts = []
        with torch.no_grad():
            for start in range(0, len(pictures), _TOGETHER):
                part = pictures[start : start + _TOGETHER]
                empty = part.new_zeros((_TOGETHER - len(part), *part.shape[1:]))
                together = torch.cat([part, empty]).contiguous(memory_format=torch.channels_last)
                maps = self._encode_all(together)[_FEATURES][: len(part)]
                if torch.is_autocast_enabled(part.device.type):  # ACT goes on in that precision, so nothing is lost
                    maps = maps.to(torch.get_autocast_dtype(part.device.type))
                parts.append(maps.cpu().contiguous())
        return torch.cat(parts)

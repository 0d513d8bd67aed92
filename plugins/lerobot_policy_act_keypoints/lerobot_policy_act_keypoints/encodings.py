"""Cache of an encoder's output: every image of a dataset is decoded and encoded once."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

_BATCH_SIZE = 32
"""Frames that are encoded at once. Smaller batches are filled with copies, since the last bits of an encoding depend on
the size of the batch."""


class Encodings:
    """Encoded frames of an `act_keypoints` policy.

    Attributes:
        known: (num_frames,) whether a frame, by its index in the dataset, is encoded; its images are not needed again.
    """

    def __init__(self, num_frames: int) -> None:
        self.known: NDArray[np.bool_] = np.zeros(num_frames, np.bool_)
        self._kept: torch.Tensor | None = None

    def serve(self, policy: Any) -> None:
        """Replace the encoder of a policy for batches that have the key "index", as those of a dataset do."""
        encode = policy.encode

        def look_up(batch: dict[str, Any]) -> torch.Tensor:
            if batch.get("index") is None:
                found: torch.Tensor = encode(batch)
                return found
            index = batch["index"].reshape(-1).cpu().numpy()
            new = np.flatnonzero(~self.known[index])
            for start in range(0, len(new), _BATCH_SIZE):
                self._keep(index, new[start : start + _BATCH_SIZE], batch, encode)
            assert self._kept is not None
            return self._kept[index].to(batch["index"].device)

        policy.encode = look_up

    def _keep(self, index: NDArray[np.int64], places: NDArray[np.int64], batch: dict[str, Any], encode: Any) -> None:
        padded = np.resize(places, _BATCH_SIZE)
        part = {key: value[padded] for key, value in batch.items() if key.startswith("observation.")}
        if "task" in batch:
            part["task"] = [batch["task"][place] for place in padded]
        made = encode(part)[: len(places)].cpu()
        if self._kept is None:
            self._kept = made.new_empty((len(self.known), made.shape[1]))
        self._kept[index[places]] = made
        self.known[index[places]] = True

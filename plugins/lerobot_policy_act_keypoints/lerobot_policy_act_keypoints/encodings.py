"""What an encoder that is not trained makes of a dataset's frames: every image is decoded and encoded once."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

_TOGETHER = 32
"""Frames that are encoded at once. Always as many (with copies), so that what comes out of a frame does not depend, in
its last bits, on how many others are new."""


class Encodings:
    """The numbers that the encoder of an `act_keypoints` policy makes of each frame, kept from the first time on.

    Attributes:
        known: (num_frames,) by the dataset's index; the images of these are not asked for again.
    """

    def __init__(self, num_frames: int) -> None:
        self.known: NDArray[np.bool_] = np.zeros(num_frames, np.bool_)
        self._kept: torch.Tensor | None = None

    def serve(self, policy: Any) -> None:
        """Answer in place of a policy's encoder, for batches that have the key "index", as those of a dataset do."""
        encode = policy.encode

        def look_up(batch: dict[str, Any]) -> torch.Tensor:
            if batch.get("index") is None:
                found: torch.Tensor = encode(batch)
                return found
            index = batch["index"].reshape(-1).cpu().numpy()
            new = np.flatnonzero(~self.known[index])
            for start in range(0, len(new), _TOGETHER):
                self._keep(index, new[start : start + _TOGETHER], batch, encode)
            assert self._kept is not None
            return self._kept[index].to(batch["index"].device)

        policy.encode = look_up

    def _keep(self, index: NDArray[np.int64], places: NDArray[np.int64], batch: dict[str, Any], encode: Any) -> None:
        padded = np.resize(places, _TOGETHER)
        part = {key: value[padded] for key, value in batch.items() if key.startswith("observation.")}
        if "task" in batch:
            part["task"] = [batch["task"][place] for place in padded]
        made = encode(part)[: len(places)].cpu()
        if self._kept is None:
            self._kept = made.new_empty((len(self.known), made.shape[1]))
        self._kept[index[places]] = made
        self.known[index[places]] = True

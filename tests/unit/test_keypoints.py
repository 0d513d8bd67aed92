"""The policy whose images come as keypoints: where its maps point, and that each frame is encoded once."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

STATE, FRONT = "observation.state", "observation.images.front"


def test_a_keypoint_is_where_the_map_is_high() -> None:
    """A map that is high around one place of the image, which is told in [-1, 1], x to the right and y down."""
    from demorec.lerobot_policy import KeypointEncoder

    encoder = KeypointEncoder(num_cameras=1, state_dim=2, num_keypoints=1, channels=4, num_targets=3).eval()
    encoder.eyes[0] = torch.nn.AvgPool3d((3, 4, 4))  # a map is the grey image, a quarter of its size
    image = torch.zeros(1, 3, 40, 80)
    image[0, :, 4:8, 60:64] = 50.0
    keypoints, targets = encoder([image], torch.zeros(1, 2))
    across, down = np.linspace(-1, 1, 20)[15], np.linspace(-1, 1, 10)[1]
    assert keypoints[0].tolist() == pytest.approx([across, down, 5.0], abs=1e-5)
    assert targets.shape == (1, 3)


class Policy:
    """Counts the frames that it encodes; what it makes of one depends on nothing else."""

    def __init__(self) -> None:
        self.config = SimpleNamespace(type="act_keypoints")
        self.encoded: list[int] = []

    def encode(self, batch: dict[str, torch.Tensor]) -> torch.Tensor:
        self.encoded += batch[STATE][:, 0].int().tolist()
        return torch.cat([batch[STATE], 3 * batch[FRONT].mean((2, 3))], dim=1)


def batch(*index: int, is_black: Any = None) -> dict[str, Any]:
    rows = torch.tensor(index)
    images = rows.float().reshape(-1, 1, 1, 1).expand(-1, 3, 2, 2).clone()
    if is_black is not None:
        images[torch.from_numpy(is_black[list(index)])] = 0
    return {"index": rows, STATE: rows.float().reshape(-1, 1), FRONT: images}


def test_each_frame_is_encoded_once_and_its_image_is_not_needed_again() -> None:
    from demorec.learn.training.encodings import Encodings

    policy, reference, encodings = Policy(), Policy(), Encodings(100)
    encodings.serve(policy)
    for rows in ((3, 9, 3, 40), (9, 41, 99), tuple(range(80)), (99, 0, 41)):
        found = policy.encode(batch(*rows, is_black=encodings.known))
        torch.testing.assert_close(found, reference.encode(batch(*rows)), rtol=0, atol=0)
    assert set(policy.encoded) == {*range(80), 99}
    assert encodings.known.sum() == 81
    assert policy.encode({key: value for key, value in batch(5).items() if key != "index"}).shape == (1, 4)

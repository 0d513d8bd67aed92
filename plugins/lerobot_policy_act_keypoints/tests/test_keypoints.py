"""The policy with keypoints in place of images: positions of its maps, and one encoding per frame."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

STATE, FRONT = "observation.state", "observation.images.front"


def test_a_keypoint_is_where_the_map_is_high() -> None:
    """Check a map that is high around one position of the image, which is in [-1, 1], x to the right and y down."""
    from lerobot_policy_act_keypoints.modeling_act_keypoints import KeypointEncoder

    encoder = KeypointEncoder(num_cameras=1, state_dim=2, num_keypoints=1, channels=4, num_targets=3).eval()
    encoder.eyes[0] = torch.nn.AvgPool3d((3, 4, 4))  # a map is the grey image, a quarter of its size
    image = torch.zeros(1, 3, 40, 80)
    image[0, :, 4:8, 60:64] = 50.0
    keypoints, targets = encoder([image], torch.zeros(1, 2))
    across, down = np.linspace(-1, 1, 20)[15], np.linspace(-1, 1, 10)[1]
    assert keypoints[0].tolist() == pytest.approx([across, down, 5.0], abs=1e-5)
    assert targets.shape == (1, 3)


def test_a_place_is_the_same_in_any_batch_and_nearly_so_on_any_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """Check that convolutions in bfloat16, if the CPU has it, move keypoints by up to a twentieth of a pixel."""
    from lerobot_policy_act_keypoints import modeling_act_keypoints as policy

    torch.manual_seed(0)
    encoder = policy.KeypointEncoder(num_cameras=1, state_dim=2, num_keypoints=16, channels=16, num_targets=3).eval()
    torch.nn.init.constant_(encoder.temperature, 5.0)  # maps with a clear peak
    image = torch.rand(32, 3, 12, 16).repeat_interleave(8, 2).repeat_interleave(8, 3)
    found = {}
    for has_bfloat16 in (False, True):
        monkeypatch.setattr(policy, "_has_bfloat16", lambda device, has=has_bfloat16: has)
        with torch.no_grad():
            found[has_bfloat16] = encoder([image], torch.zeros(32, 2))[0]
            alone = torch.cat([encoder([image[k : k + 1]], torch.zeros(1, 2))[0] for k in range(4)])
        torch.testing.assert_close(alone, found[has_bfloat16][:4], rtol=0, atol=1e-3)
    places = {has: keypoints[:, :32] for has, keypoints in found.items()}  # x and y of each map
    assert places[False].std() > 0.01
    moved, pixel = (places[True] - places[False]).abs(), 2 / image.shape[3]
    assert 0 < moved.median() < pixel / 20
    assert moved.max() < pixel


class Policy:
    """Counts the frames that it encodes; each encoding depends on the frame alone."""

    def __init__(self) -> None:
        self.config = SimpleNamespace(type="act_keypoints")
        self.encoded: list[int] = []

    def encode(self, batch: dict[str, torch.Tensor]) -> torch.Tensor:
        rows = batch[STATE][:, 0].int().tolist()
        assert batch["task"] == [f"take {row}" for row in rows]
        self.encoded += rows
        return torch.cat([batch[STATE], 3 * batch[FRONT].mean((2, 3))], dim=1)


def batch(*index: int, is_black: Any = None) -> dict[str, Any]:
    rows = torch.tensor(index)
    images = rows.float().reshape(-1, 1, 1, 1).expand(-1, 3, 2, 2).clone()
    if is_black is not None:
        images[torch.from_numpy(is_black[list(index)])] = 0
    return {"index": rows, STATE: rows.float().reshape(-1, 1), FRONT: images, "task": [f"take {row}" for row in index]}


def test_each_frame_is_encoded_once_and_its_image_is_not_needed_again() -> None:
    from lerobot_policy_act_keypoints.encodings import Encodings

    policy, reference, encodings = Policy(), Policy(), Encodings(100)
    encodings.serve(policy)
    for rows in ((3, 9, 3, 40), (9, 41, 99), tuple(range(80)), (99, 0, 41)):
        found = policy.encode(batch(*rows, is_black=encodings.known))
        torch.testing.assert_close(found, reference.encode(batch(*rows)), rtol=0, atol=0)
    assert set(policy.encoded) == {*range(80), 99}
    assert encodings.known.sum() == 81
    assert policy.encode({key: value for key, value in batch(5).items() if key != "index"}).shape == (1, 4)


def test_a_place_follows_the_instruction_and_not_the_other_sentences_of_a_batch() -> None:
    """Check that the order of words matters, capitals and punctuation do not; all unknown words are equal."""
    from lerobot_policy_act_keypoints.modeling_act_keypoints import KeypointEncoder, vocabulary_of

    torch.manual_seed(0)
    texts = ["put the red cube onto the blue one", "put the blue cube onto the red one"]
    vocabulary = vocabulary_of(texts)
    assert vocabulary == ("blue", "cube", "one", "onto", "put", "red", "the")
    encoder = KeypointEncoder(
        num_cameras=2, state_dim=2, num_keypoints=4, channels=4, num_targets=3, vocabulary=vocabulary
    ).eval()
    torch.nn.init.constant_(encoder.temperature, 5.0)
    image = torch.rand(1, 3, 24, 32)

    def places(*instructions: str) -> torch.Tensor:
        count = len(instructions)
        with torch.no_grad():
            return encoder([image.expand(count, -1, -1, -1)] * 2, torch.zeros(count, 2), instructions)[0]

    alone = torch.cat([places(text) for text in texts])
    assert (alone[0] - alone[1]).abs().max() > 1e-3
    together = places(*texts, "Put the RED cube onto the blue one!", "red", "fetch", "grasp", "")
    torch.testing.assert_close(together[:3], alone[[0, 1, 0]], rtol=0, atol=1e-3)
    torch.testing.assert_close(together[4], together[5], rtol=0, atol=0)
    with pytest.raises(ValueError, match="its batches need the key 'task'"):
        encoder([image], torch.zeros(1, 2))


def test_where_all_instructions_are_the_same_none_is_read() -> None:
    from lerobot_policy_act_keypoints.modeling_act_keypoints import vocabulary_of

    assert vocabulary_of(["stack the cubes"] * 3) == vocabulary_of([]) == ()

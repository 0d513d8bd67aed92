"""What a frozen encoder made of a picture is kept, and is what it makes of it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch

CAMERAS = ("observation.images.a", "observation.images.b")


class Backbone(torch.nn.Module):  # type: ignore[misc]
    """Counts the pictures that it is given; what it makes of one depends on nothing else."""

    def __init__(self) -> None:
        super().__init__()
        self.scale = torch.nn.Parameter(torch.tensor(3.0))
        self.given = 0

    def forward(self, pictures: torch.Tensor) -> dict[str, torch.Tensor]:
        self.given += int((pictures.flatten(1).abs().sum(1) > 0).sum())
        return {"feature_map": self.scale * pictures.mean(1, keepdim=True)}


class Policy(torch.nn.Module):  # type: ignore[misc]
    """As ACT: one camera after the other goes through the encoder."""

    def __init__(self, kind: str = "act", cameras: tuple[str, ...] = CAMERAS) -> None:
        super().__init__()
        self.config = SimpleNamespace(type=kind, image_features=dict.fromkeys(cameras))
        self.model = torch.nn.Module()
        self.model.backbone = Backbone()

    def forward(self, batch: dict[str, Any]) -> torch.Tensor:
        return torch.stack([self.model.backbone(batch[camera])["feature_map"] for camera in CAMERAS])


def batch(*index: int) -> dict[str, Any]:
    pictures = torch.arange(1, 101, dtype=torch.float32).reshape(100, 1, 1, 1).expand(100, 3, 2, 2)
    rows = torch.tensor(index)
    return {"index": rows, CAMERAS[0]: pictures[rows], CAMERAS[1]: -pictures[rows]}


def frozen(limit_bytes: int) -> Policy:
    from demorec.learn.training.frozen import freeze_encoder

    policy = Policy()
    names = list(policy.state_dict())
    freeze_encoder(policy, num_frames=100, limit_bytes=limit_bytes)
    assert list(policy.state_dict()) == names
    return policy


def test_each_picture_is_encoded_once() -> None:
    policy, reference = frozen(1 << 20), Policy()
    for rows in ((3, 9, 3, 40), (9, 41, 99), tuple(range(80)), (99, 0, 41)):
        torch.testing.assert_close(policy(batch(*rows)), reference(batch(*rows)), rtol=0, atol=0)
    seen = {3, 9, 40, 41, 99, *range(80)}
    twice_at_once = 1  # a picture that is in a batch twice while it is new
    assert policy.model.backbone.given == 2 * (len(seen) + twice_at_once)
    assert not policy(batch(5)).requires_grad


def test_what_does_not_fit_is_encoded_again() -> None:
    room = 2 * 4 * 5  # of five maps of each of two cameras: 2 x 2 float32 would be 16 bytes each
    policy, reference = frozen(room * 4), Policy()
    for _ in range(2):
        torch.testing.assert_close(policy(batch(*range(8))), reference(batch(*range(8))), rtol=0, atol=0)
    assert policy.model.backbone.given == 2 * (8 + 3)


def test_with_autocast_half_as_much_is_kept_as_act_would_take() -> None:
    """The room of ten maps of float32 holds twenty of bfloat16, the precision in which ACT goes on."""
    policy, reference = frozen(20 * 16), Policy()
    for _ in range(2):
        with torch.autocast("cpu", dtype=torch.bfloat16):
            found = policy(batch(*range(20)))
        assert found.dtype == torch.bfloat16
        torch.testing.assert_close(found, reference(batch(*range(20))).bfloat16(), rtol=0, atol=0)
    assert policy.model.backbone.given == 2 * 20


@pytest.mark.parametrize("policy", [Policy("diffusion"), Policy(cameras=())])
def test_only_act_with_pictures_has_such_an_encoder(policy: Policy) -> None:
    from demorec.core.errors import ConfigError
    from demorec.learn.training.frozen import freeze_encoder

    with pytest.raises(ConfigError, match="--freeze-encoder is for ACT policies with pictures"):
        freeze_encoder(policy, num_frames=1, limit_bytes=0)

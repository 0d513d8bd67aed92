"""The encoder of ACT's pictures, taught to see before the policy learns to act.

LeRobot's ACT has a ResNet whose normalisation is frozen (`FrozenBatchNorm2d`). With weights of ImageNet that is as
meant; from random weights it is no normalisation at all, and such a network learns to see very slowly. Here the same
ResNet is trained with batch normalisation, whose statistics then become the frozen ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
import torchvision
from torch import nn
from torchvision.models._utils import IntermediateLayerGetter

_FEATURES, _HIDDEN = "feature_map", 512
_BY_CAMERA_WEIGHT = 0.3


class KeyframeEncoder(nn.Module):  # type: ignore[misc]
    """ACT's ResNet with batch normalisation, and heads that tell the targets from what it makes of the pictures.

    Args:
        config: Of the ACT policy: which ResNet, and whether its last stage is dilated.
        num_cameras: Pictures of each frame, which all go through one network, as in ACT.
        state_dim: Numbers of the robot's state.
        num_targets: Numbers to tell.
    """

    def __init__(self, config: Any, *, num_cameras: int, state_dim: int, num_targets: int) -> None:
        super().__init__()
        network = getattr(torchvision.models, config.vision_backbone)(
            weights=None, replace_stride_with_dilation=[False, False, config.replace_final_stride_with_dilation]
        )
        width = network.fc.in_features
        backbone = IntermediateLayerGetter(network, return_layers={"layer4": _FEATURES})
        self.backbone = backbone.to(memory_format=torch.channels_last)
        self.by_camera = nn.ModuleList(nn.Linear(width, num_targets) for _ in range(num_cameras))
        self.together = nn.Sequential(
            nn.Linear(width * num_cameras + state_dim, _HIDDEN), nn.ReLU(), nn.Linear(_HIDDEN, num_targets)
        )

    def forward(self, pictures: Sequence[torch.Tensor], state: torch.Tensor) -> tuple[torch.Tensor, list[torch.Tensor]]:
        """The targets from all cameras and the state (B, K), and from each camera alone, linearly.

        ACT reads the encoding through a linear layer, so that what it needs shall lie there linearly.

        Args:
            pictures: Of each camera, (B, 3, H, W), normalised.
            state: (B, S), normalised.
        """
        encodings = self._encodings(pictures)
        together: torch.Tensor = self.together(torch.cat([*encodings, state], dim=1))
        return together, [head(encoding) for head, encoding in zip(self.by_camera, encodings, strict=True)]

    def _encodings(self, pictures: Sequence[torch.Tensor]) -> list[torch.Tensor]:
        """Of each camera; those whose pictures are of one size go through the network together."""
        sizes: dict[torch.Size, list[int]] = {}
        for camera, picture in enumerate(pictures):
            sizes.setdefault(picture.shape[2:], []).append(camera)
        found: dict[int, torch.Tensor] = {}
        for cameras in sizes.values():
            stacked = torch.cat([pictures[camera] for camera in cameras]).contiguous(memory_format=torch.channels_last)
            maps = self.backbone(stacked)[_FEATURES].mean((2, 3))
            found |= zip(cameras, maps.chunk(len(cameras)), strict=True)
        return [found[camera] for camera in range(len(pictures))]

    def weights(self) -> dict[str, torch.Tensor]:
        """Of the ResNet, as ACT's own with frozen normalisation takes them."""
        state = self.backbone.state_dict()
        return {name: values.contiguous() for name, values in state.items() if not name.endswith("num_batches_tracked")}


def loss_of(told: tuple[torch.Tensor, list[torch.Tensor]], targets: torch.Tensor) -> torch.Tensor:
    """L1 of the normalised targets, and a share of that of each camera alone."""
    together, by_camera = told
    loss = nn.functional.l1_loss(together, targets)
    for one in by_camera:
        loss = loss + _BY_CAMERA_WEIGHT * nn.functional.l1_loss(one, targets)
    return loss

"""An encoder of ACT's pictures that learns, before the policy does, where the hand will be at its next keyframes.

A keyframe is a moment at which the gripper is told to close or to open (James and Davison, "Q-attention", 2021; PerAct,
Shridhar et al., 2022). Keyframes are read off the robot's own poses and commands, so that nothing is needed that a real
recording does not have, poses of objects least of all; yet the first of them is where the object is, and the second
where it has to go.

LeRobot's ACT has a ResNet whose normalisation is frozen (`FrozenBatchNorm2d`). With weights of ImageNet that is as
meant; from random weights it is no normalisation at all, and such a network learns to see very slowly. Here the same
ResNet is trained with batch normalisation, whose statistics then become the frozen ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import torchvision
from numpy.typing import NDArray
from torch import nn
from torchvision.models._utils import IntermediateLayerGetter

from demorec.episode.features import near_field

NUM_KEYFRAMES = 2
_FEATURES, _HIDDEN = "feature_map", 512
_BY_CAMERA_WEIGHT = 0.3

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class KeyframeTargets:
    """What an encoder of pictures learns to tell of each frame.

    Attributes:
        values: (N, K) metres, and sines and cosines of angles.
        names: Of the components.
        offsets: Places of the offset from the TCP to the next keyframe, base frame, x, y, z.
    """

    values: NDArray[np.float32]
    names: tuple[str, ...]
    offsets: tuple[int, int, int]


def find_keyframes(opening: NDArray[np.floating], episode: NDArray[np.integer]) -> NDArray[np.int64]:
    """The next frames at which the gripper is told to close or to open.

    Args:
        opening: (N,) commanded opening, in any unit. It is open above the middle of all that is commanded.
        episode: (N,) number of each frame's episode; its frames follow one another.

    Returns:
        (N, 2) indices of the next one and of the one after it; the episode's last frame where there is none.
    """
    is_open = opening > (opening.min() + opening.max()) / 2
    frames = np.arange(len(episode))
    changes = np.flatnonzero((np.diff(is_open) != 0) & (np.diff(episode) == 0)) + 1
    ends = np.append(np.flatnonzero(np.diff(episode)), len(episode) - 1)
    last = ends[np.searchsorted(ends, frames)]
    found = np.empty((len(episode), NUM_KEYFRAMES), np.int64)
    place = np.searchsorted(changes, frames, side="right")
    for k in range(NUM_KEYFRAMES):
        candidate = np.append(changes, len(episode))[np.minimum(place + k, len(changes))]
        found[:, k] = np.minimum(candidate, last)
    return found


def keyframe_targets(
    position: NDArray[np.floating], quat_xyzw: NDArray[np.floating], keyframes: NDArray[np.int64]
) -> KeyframeTargets:
    """The hand's poses at its next keyframes, as they are and as seen from where it is now.

    Args:
        position: (N, 3) of the TCP, metres, base frame.
        quat_xyzw: (N, 4) of the TCP, base frame.
        keyframes: As of `find_keyframes`.
    """
    xyz = position.astype(np.float64)
    yaw = _yaw(quat_xyzw.astype(np.float64))
    columns: dict[str, Array] = {}
    for k in range(NUM_KEYFRAMES):
        then = keyframes[:, k]
        offset = xyz[then] - xyz
        x_in_hand = np.cos(yaw) * offset[:, 0] + np.sin(yaw) * offset[:, 1]
        y_in_hand = np.cos(yaw) * offset[:, 1] - np.sin(yaw) * offset[:, 0]
        for axis, name in enumerate("xyz"):
            columns[f"keyframe_{k}.{name}"] = xyz[then, axis]
            columns[f"keyframe_{k}.from_tcp.{name}"] = offset[:, axis]
            columns[f"keyframe_{k}.from_tcp.near_{name}"] = near_field(offset[:, axis])
        for name, in_hand in (("x", x_in_hand), ("y", y_in_hand)):
            columns[f"keyframe_{k}.from_tcp.hand_{name}"] = in_hand
            columns[f"keyframe_{k}.from_tcp.near_hand_{name}"] = near_field(in_hand)
        for name, angle in (("yaw", yaw[then]), ("from_tcp.yaw", yaw[then] - yaw)):
            columns[f"keyframe_{k}.{name}.sin2"] = np.sin(2 * angle)  # two fingers: half a turn is the same
            columns[f"keyframe_{k}.{name}.cos2"] = np.cos(2 * angle)
    between = xyz[keyframes[:, 1]] - xyz[keyframes[:, 0]]
    for axis, name in enumerate("xyz"):
        columns[f"keyframe_1.from_keyframe_0.{name}"] = between[:, axis]
        columns[f"keyframe_1.from_keyframe_0.near_{name}"] = near_field(between[:, axis])
    names = tuple(columns)
    x, y, z = (names.index(f"keyframe_0.from_tcp.{name}") for name in "xyz")
    return KeyframeTargets(
        values=np.stack(list(columns.values()), axis=1).astype(np.float32), names=names, offsets=(x, y, z)
    )


def _yaw(quat_xyzw: Array) -> Array:
    """(N,) angle about the base's z of the x axes of frames, radians."""
    x, y, z, w = quat_xyzw.T
    return np.asarray(np.arctan2(2 * (x * y + z * w), 1 - 2 * (y * y + z * z)))


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

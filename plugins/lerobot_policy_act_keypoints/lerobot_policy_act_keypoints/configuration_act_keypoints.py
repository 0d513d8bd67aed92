"""Settings of the policy `act_keypoints`."""

from __future__ import annotations

from dataclasses import dataclass, field

from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.policies.act.configuration_act import ACTConfig


@PreTrainedConfig.register_subclass("act_keypoints")
@dataclass
class ActKeypointsConfig(ACTConfig):  # type: ignore[misc]
    """Flags `--policy.NAME=...`: those of ACT, except that the ones about the ResNet have no effect.

    Attributes:
        num_keypoints: Maps of each camera.
        encoder_channels: Channels of the first convolutions; the later ones have twice as many.
        num_targets: Numbers that the encoder predicts in addition to the keypoints; set by act-keypoints-pretrain.
        vocabulary: Words of instructions that the encoder reads; empty if all episodes have the same instruction; set
            by act-keypoints-pretrain.
        normalization_mapping: The encoder normalises its inputs by the dataset that it was trained on. LeRobot would by
            each dataset that the policy is trained on, and images by ImageNet.
    """

    num_keypoints: int = 32
    encoder_channels: int = 32
    num_targets: int = 0
    vocabulary: tuple[str, ...] = ()
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "VISUAL": NormalizationMode.IDENTITY,
            "STATE": NormalizationMode.IDENTITY,
            "ACTION": NormalizationMode.MEAN_STD,
        }
    )

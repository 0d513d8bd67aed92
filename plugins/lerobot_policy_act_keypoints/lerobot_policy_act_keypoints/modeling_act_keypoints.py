"""ACT that gets keypoints instead of images.

ACT's own ResNet gives maps of features, from which a position is hard to read to the millimetre. Here a small
convolutional network makes a few maps of each image, and the policy gets the position that each map points at: its
expectation under a softmax over the map (Finn et al., "Deep Spatial Autoencoders for Visuomotor Learning", 2016). Where
episodes have different instructions, the instruction scales and shifts the network's last features (FiLM: Perez et al.,
2018), so that a map can look for the object that is named. The network is trained before the policy, by `pretrain`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import torch
from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACT, ACTPolicy
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE
from torch import nn

from lerobot_policy_act_keypoints.configuration_act_keypoints import ActKeypointsConfig

__all__ = ["ActKeypointsPolicy", "KeypointEncoder", "vocabulary_of"]

_HIDDEN_SIZE = 256
_WORD_SIZE = 32
_INSTRUCTION_SIZE = 64
_WORD = re.compile(r"\w+")
_HEIGHT_SCALE = 0.1
"""Factor of a map's maximum, next to its coordinates in [-1, 1]."""
_MIN_STD = 1e-4
"""Divisor of inputs that hardly change."""


def vocabulary_of(instructions: Iterable[str]) -> tuple[str, ...]:
    """Sorted words of instructions; empty if all instructions are equal."""
    different = set(instructions)
    return tuple(sorted({word for text in different for word in _words(text)})) if len(different) > 1 else ()


def _words(text: str) -> list[str]:
    return _WORD.findall(text.lower())


class _Gru(nn.GRU):  # type: ignore[misc]
    """A GRU that keeps its weights in separate tensors on a GPU: safetensors cannot save parts of cuDNN's buffer."""

    def flatten_parameters(self) -> None:
        """Do nothing."""


class _InstructionReader(nn.Module):  # type: ignore[misc]
    """Network from instructions to scale and shift of the features of each camera.

    Args:
        vocabulary: Known words; all other words are treated as one.
        num_cameras, num_features: Shape of the maps' last features.
    """

    def __init__(self, vocabulary: Sequence[str], num_cameras: int, num_features: int) -> None:
        super().__init__()
        self._number = {word: number for number, word in enumerate(vocabulary, start=1)}  # 0 is any other
        self._shape = (num_cameras, 2, num_features)
        self.words = nn.Embedding(len(vocabulary) + 1, _WORD_SIZE)
        self.sentence = _Gru(_WORD_SIZE, _INSTRUCTION_SIZE, batch_first=True)
        self.modulation = nn.Linear(_INSTRUCTION_SIZE, num_cameras * 2 * num_features)
        nn.init.zeros_(self.modulation.bias)

    def forward(self, instructions: Sequence[str]) -> torch.Tensor:
        """Compute scale minus 1, and shift, of the features: (num_cameras, 2, B, num_features)."""
        different, device = sorted(set(instructions)), self.words.weight.device
        numbers = [[self._number.get(word, 0) for word in _words(text)] or [0] for text in different]
        sentences = [self.words(torch.tensor(row, device=device)) for row in numbers]
        with torch.backends.cudnn.flags(enabled=False):  # it warns about weights in separate buffers
            _, state = self.sentence(nn.utils.rnn.pack_sequence(sentences, enforce_sorted=False))
        found: torch.Tensor = self.modulation(state[0])
        place = {text: row for row, text in enumerate(different)}
        return found[[place[text] for text in instructions]].unflatten(1, self._shape).permute(1, 2, 0, 3)


class KeypointEncoder(nn.Module):  # type: ignore[misc]
    """Network from images and the robot's state to keypoints and predicted targets.

    Args:
        num_cameras: Number of cameras, each with its own network.
        state_dim: Length of the robot's state.
        num_keypoints, channels, num_targets, vocabulary: See `ActKeypointsConfig`.
    """

    def __init__(
        self,
        *,
        num_cameras: int,
        state_dim: int,
        num_keypoints: int,
        channels: int,
        num_targets: int,
        vocabulary: Sequence[str] = (),
    ) -> None:
        super().__init__()
        self.eyes = nn.ModuleList(_maps(channels, num_keypoints) for _ in range(num_cameras))
        self.temperature = nn.Parameter(torch.zeros(num_cameras, num_keypoints))
        for name, shape in (("image", (num_cameras, 3, 1, 1)), ("state", (state_dim,))):
            self.register_buffer(f"{name}_mean", torch.zeros(shape))
            self.register_buffer(f"{name}_std", torch.ones(shape))
        self.num_numbers = 3 * num_keypoints * num_cameras
        self.targets = nn.Sequential(
            nn.Linear(self.num_numbers + state_dim, _HIDDEN_SIZE), nn.ReLU(),
            nn.Linear(_HIDDEN_SIZE, _HIDDEN_SIZE), nn.ReLU(),
            nn.Linear(_HIDDEN_SIZE, num_targets),
        )  # fmt: skip
        self.linear_targets = nn.Linear(self.num_numbers + state_dim, num_targets)
        self.reader = _InstructionReader(vocabulary, num_cameras, 2 * channels) if vocabulary else None

    def forward(
        self, images: Sequence[torch.Tensor], state: torch.Tensor, instructions: Sequence[str] | None = None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Compute keypoints (B, 3 K num_cameras) and targets (B, num_targets).

        Args:
            images: Images of each camera, (B, 3, H, W) in [0, 1].
            state: (B, S).
            instructions: B texts; used only with a vocabulary.

        Raises:
            ValueError: Instructions are needed.
        """
        if self.reader is not None and instructions is None:
            raise ValueError("This act_keypoints reads instructions: its batches need the key 'task'.")
        # Coordinates are computed in float32, since bfloat16 has 8 bits. Maps in bfloat16 matter little: between CPUs
        # with and without it, the next keyframe moves by 0.02 mm in the median, 0.14 mm for 99 of 100 frames.
        with torch.autocast(state.device.type, enabled=False):
            modulation = None if self.reader is None or instructions is None else self.reader(instructions)
            found = [
                self._keypoints(camera, image.float(), None if modulation is None else modulation[camera])
                for camera, image in enumerate(images)
            ]
            keypoints = torch.cat(found, dim=1)
            return keypoints, self.targets_of(keypoints, state)

    def targets_of(self, keypoints: torch.Tensor, state: torch.Tensor) -> torch.Tensor:
        """Predict targets (B, num_targets) from keypoints (B, 3 K num_cameras) and the state (B, S).

        Most targets are nearly linear in the keypoints; without the linear part, the error from afar doubles.
        """
        numbers = torch.cat([keypoints, self.normalized(state)], dim=1)
        targets: torch.Tensor = self.linear_targets(numbers) + self.targets(numbers)
        return targets

    def normalized(self, state: torch.Tensor) -> torch.Tensor:
        """Normalise the state, (B, S)."""
        return (state.float() - self.state_mean) / self.state_std

    def normalize_by(self, stats: Mapping[str, Mapping[str, Any]], cameras: Sequence[str]) -> None:
        """Set mean and standard deviation of images and state from a dataset's statistics."""
        for moment in ("mean", "std"):
            images = [torch.as_tensor(stats[camera][moment]).reshape(3, 1, 1) for camera in cameras]
            getattr(self, f"image_{moment}").copy_(torch.stack(images))
            getattr(self, f"state_{moment}").copy_(torch.as_tensor(stats[OBS_STATE][moment]).reshape(-1))
        self.state_std.clamp_(min=_MIN_STD)
        self.image_std.clamp_(min=_MIN_STD)

    def _keypoints(self, camera: int, image: torch.Tensor, modulation: torch.Tensor | None) -> torch.Tensor:
        """Compute expected x, expected y, and height of the maps of one camera, (B, 3 K)."""
        image = (image - self.image_mean[camera]) / self.image_std[camera]
        eye, image = self.eyes[camera], image.contiguous(memory_format=torch.channels_last)
        with torch.autocast(image.device.type, torch.bfloat16, enabled=_has_bfloat16(image.device)):
            if modulation is None:
                maps = eye(image).float()
            else:
                features = eye[:-2](image)
                scale, shift = modulation.to(features.dtype)[..., None, None]
                maps = eye[-2:](features * (1 + scale) + shift).float()
        height, width = maps.shape[2:]
        weight = (maps.flatten(2) * self.temperature[camera].exp()[:, None]).softmax(2).unflatten(2, (height, width))
        across, down = (torch.linspace(-1, 1, size, device=maps.device) for size in (width, height))
        x, y = (weight.sum(2) * across).sum(2), (weight.sum(3) * down).sum(2)
        return torch.cat([x, y, _HEIGHT_SCALE * maps.amax((2, 3))], dim=1)


def _has_bfloat16(device: torch.device) -> bool:
    """Whether the device is a CPU with native bfloat16, which halves the time of convolutions."""
    return device.type == "cpu" and bool(torch.cpu._is_avx512_bf16_supported())


def _maps(channels: int, num_keypoints: int) -> nn.Module:
    """Network from an image to maps of a quarter of its width and height."""
    layers: list[nn.Module] = []
    sizes = [3, channels, channels, 2 * channels, 2 * channels, 2 * channels]
    for number, (before, after) in enumerate(pairwise(sizes)):
        stride = 2 if number in (0, 2) else 1
        layers += [nn.Conv2d(before, after, 3, stride, 1, bias=False), nn.BatchNorm2d(after), nn.ReLU(inplace=True)]
    network = nn.Sequential(*layers, nn.Conv2d(sizes[-1], num_keypoints, 1))
    return network.to(memory_format=torch.channels_last)


class ActKeypointsPolicy(ACTPolicy):  # type: ignore[misc]
    """ACT with the output of a `KeypointEncoder` as its environment state; only ACT is trained.

    Args:
        config: Settings, with images and a state among the inputs.
        **kwargs: Further arguments of LeRobot, which are ignored.
    """

    config_class = ActKeypointsConfig
    name = "act_keypoints"

    def __init__(self, config: ActKeypointsConfig, **kwargs: Any) -> None:
        super(ACTPolicy, self).__init__(config)
        if not config.image_features or config.robot_state_feature is None:
            raise ValueError("act_keypoints needs images and observation.state among its inputs.")
        if {config.normalization_mapping.get(kind) for kind in ("VISUAL", "STATE")} != {NormalizationMode.IDENTITY}:
            raise ValueError("act_keypoints normalises images and state by itself: leave normalization_mapping out.")
        encoder = KeypointEncoder(
            num_cameras=len(config.image_features),
            state_dim=config.robot_state_feature.shape[0],
            num_keypoints=config.num_keypoints,
            channels=config.encoder_channels,
            num_targets=config.num_targets,
            vocabulary=config.vocabulary,
        )
        self.model = ACT(_without_images(config, encoder.num_numbers + config.num_targets))
        self.encoder = encoder.requires_grad_(False)
        self.reset()

    def train(self, mode: bool = True) -> ActKeypointsPolicy:
        """Set the mode; the encoder stays in evaluation mode, so its statistics do not change."""
        super().train(mode)
        self.encoder.eval()
        return self

    def forward(self, batch: dict[str, torch.Tensor]) -> tuple[torch.Tensor, dict[str, Any]]:
        """Compute ACT's loss of a batch."""
        loss: tuple[torch.Tensor, dict[str, Any]] = super().forward(self._numbers(batch))
        return loss

    def predict_action_chunk(self, batch: dict[str, torch.Tensor]) -> torch.Tensor:
        """Predict actions (B, chunk_size, D)."""
        return super().predict_action_chunk(self._numbers(batch))

    def encode(self, batch: dict[str, torch.Tensor]) -> torch.Tensor:
        """Encode images into keypoints and targets, (B, N)."""
        with torch.no_grad():
            images = [batch[key] for key in self.config.image_features]
            return torch.cat(self.encoder(images, batch[OBS_STATE], batch.get("task")), dim=1)

    def _numbers(self, batch: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Replace images by numbers, as ACT's inputs."""
        return batch | {OBS_STATE: self.encoder.normalized(batch[OBS_STATE]), OBS_ENV_STATE: self.encode(batch)}


def _without_images(config: ActKeypointsConfig, num_numbers: int) -> ACTConfig:
    """Settings of an ACT that gets numbers instead of images."""
    own = ACTConfig.__dataclass_fields__
    inner = ACTConfig(**{name: value for name, value in vars(config).items() if name in own and own[name].init})
    inner.input_features = {
        OBS_STATE: config.robot_state_feature,
        OBS_ENV_STATE: PolicyFeature(type=FeatureType.ENV, shape=(num_numbers,)),
    }
    return inner

"""A policy saved by LeRobot, ready to act in an environment; the only importer of torch and of LeRobot's policies."""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import io
import logging
import reprlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import ConfigError, MissingDependencyError, NotAllowedError, OptionError, describe_error
from demorec.core.files import read_json_object
from demorec.core.registry import is_allowed
from demorec.datasets.lerobot.paths import INFO_PATH
from demorec.episode.features import IMAGE_PREFIX, ActionKind

CONFIG_NAME, TRAIN_CONFIG_NAME = "config.json", "train_config.json"


def find_checkpoint(path: Path) -> Path:
    """Folder with config.json: `path`, its pretrained_model, or the last checkpoint of a training.

    Raises:
        ConfigError: No such folder.
    """
    for candidate in (path, path / "pretrained_model", path / "checkpoints" / "last" / "pretrained_model"):
        if (candidate / CONFIG_NAME).is_file():
            return candidate
    raise ConfigError(
        f"Not a policy saved by LeRobot, {CONFIG_NAME} is missing: give the output folder of lerobot-train or a "
        f"pretrained_model folder in it: {path}"
    )


def policy_config(checkpoint: Path) -> dict[str, Any]:
    """Read the policy's config as plain data. Raises ConfigError if that fails."""
    try:
        return read_json_object(checkpoint / CONFIG_NAME)
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"{CONFIG_NAME} of the policy cannot be used ({describe_error(error)}): {checkpoint}"
        ) from error


def policy_inputs(checkpoint: Path) -> dict[str, tuple[int, ...]]:
    """Read the policy's inputs: name -> shape, three dimensions of an image. Raises ConfigError if that fails."""
    plain = policy_config(checkpoint)
    try:
        inputs = {name: _shape(value["shape"]) for name, value in (plain.get("input_features") or {}).items()}
        if any(len(shape) != 3 for name, shape in inputs.items() if name.startswith(IMAGE_PREFIX)):
            raise ValueError("an image without three dimensions")
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ConfigError(f"The inputs of the policy cannot be used ({describe_error(error)}): {checkpoint}") from error
    return inputs


def _shape(value: object) -> tuple[int, ...]:
    if not isinstance(value, list) or not all(type(size) is int and size > 0 for size in value):
        raise ValueError(f"a shape of {reprlib.repr(value)}")
    return tuple(value)


def policy_digest(checkpoint: Path) -> str:
    """First 16 hex digits of the SHA-256 of the policy's config and weights."""
    sha = hashlib.sha256()
    for path in sorted(checkpoint.iterdir()):
        # The training's settings name folders of the training machine.
        if path.suffix in (".json", ".safetensors") and path.name != TRAIN_CONFIG_NAME:
            sha.update(path.name.encode() + b"\0" + path.read_bytes())
    return sha.hexdigest()[:16]


def check_steps(checkpoint: Path, allowed: Iterable[str]) -> None:
    """Refuse a policy with processing steps of classes that the user has not allowed.

    LeRobot's own steps are registry names; LeRobot imports and calls anything named by a step's "class".

    Raises:
        NotAllowedError: A step's module is not in `allowed`.
    """
    for path in sorted(checkpoint.glob("*.json")):
        try:
            steps = read_json_object(path).get("steps")
        except (OSError, ValueError):
            continue  # LeRobot cannot read it either, and reports that
        for step in steps if isinstance(steps, list) else ():
            if not isinstance(step, dict) or "registry_name" in step or "class" not in step:
                continue
            module = str(step["class"]).rpartition(".")[0]
            if not is_allowed(module, allowed):
                raise NotAllowedError(
                    f"The policy names the code of a processing step, {step['class']!r}, instead of LeRobot's name of "
                    f"one, and only you can decide whether to run it: if you trust it, add --allow {module}: {path}"
                )


def trained_action(checkpoint: Path) -> ActionKind | None:
    """Meaning of the policy's actions, from the names in its training dataset; None if that is missing or in motor
    units.
    """
    try:
        root = read_json_object(checkpoint / TRAIN_CONFIG_NAME)["dataset"]["root"]
        info = read_json_object(Path(root) / INFO_PATH)
        names = info["features"]["action"]["names"]
        first, *_, last = map(str, names if isinstance(names, list) else next(iter(names.values())))
    except (OSError, ValueError, KeyError, TypeError, IndexError, AttributeError, StopIteration):
        return None
    if last == "gripper.pos":  # motor units, which demorec's environments do not accept
        return None
    if first.endswith(".delta"):
        return "joint_increment"
    return {"tcp.x": "ee", "tcp.dx": "ee_delta"}.get(first, "joint")  # type: ignore[return-value]


class Policy:
    """Acts on one environment at a time.

    Args:
        checkpoint: As in `find_checkpoint`.
        action_steps: Actions of a chunk executed before the next observation; None: as trained.

    Raises:
        ConfigError: LeRobot cannot load it, or it lacks this setting.
        MissingDependencyError: LeRobot, or the package that registers this policy type, is not installed.
    """

    def __init__(self, checkpoint: Path, *, action_steps: int | None = None) -> None:
        try:
            import torch
            from lerobot.configs import PreTrainedConfig
            from lerobot.envs.utils import preprocess_observation
            from lerobot.policies.factory import get_policy_class, make_pre_post_processors
        except ImportError as error:
            raise MissingDependencyError(
                "Running a policy", error.name or "lerobot", "pip install 'demorec[train]'"
            ) from error
        torch.set_num_threads(1)
        self._torch, self._preprocess = torch, preprocess_observation
        kind = str(policy_config(checkpoint).get("type", ""))
        _register_plugins()
        if kind not in PreTrainedConfig.get_known_choices():
            raise _missing_plugin(kind)
        try:
            config = PreTrainedConfig.from_pretrained(checkpoint)
            config.device = "cpu"
            with contextlib.redirect_stdout(io.StringIO()):  # LeRobot prints the source of the weights
                self._policy = get_policy_class(config.type).from_pretrained(checkpoint, config=config)
            self._before, self._after = make_pre_post_processors(
                policy_cfg=config,
                pretrained_path=str(checkpoint),
                preprocessor_overrides={"device_processor": {"device": "cpu"}},
            )
        except Exception as error:  # a foreign format can fail in any way
            raise ConfigError(f"LeRobot cannot load this policy ({describe_error(error)}): {checkpoint}") from error
        if action_steps is not None:
            chunk = getattr(config, "chunk_size", None)
            if chunk is None or not 1 <= action_steps <= chunk:
                raise OptionError("action_steps", f"is {action_steps}, allowed are 1 to {chunk} (the policy's chunk).")
            config.n_action_steps = action_steps
            self._policy.config.n_action_steps = action_steps
        self._policy.eval()

    def reset(self, seed: int) -> None:
        """Begin an episode; a policy that draws random numbers uses this seed."""
        self._torch.manual_seed(seed)
        self._policy.reset()
        for steps in (self._before, self._after):
            steps.reset()

    def act(self, observation: dict[str, Any], instruction: str) -> NDArray[np.float32]:
        """(D,) action for an observation of `DemorecEnv`."""
        batch = self._preprocess(_batched(observation))
        batch["task"] = [instruction]
        with self._torch.inference_mode():
            action = self._after(self._policy.select_action(self._before(batch)))
        return np.asarray(action.to("cpu").numpy()[0], dtype=np.float32)


def _register_plugins() -> None:
    """Let LeRobot import all installed plug-ins; it logs a traceback for each that cannot be imported."""
    from lerobot.utils.import_utils import register_third_party_plugins

    level = logging.root.manager.disable
    logging.disable()
    try:
        register_third_party_plugins()
    finally:
        logging.disable(level)


def _missing_plugin(kind: str) -> MissingDependencyError:
    """Error for a policy type that no imported package registers."""
    feature, name = f"A policy of type {reprlib.repr(kind)}", f"lerobot_policy_{reprlib.repr(kind)[1:-1]}"
    try:
        if name.isidentifier():
            importlib.import_module(name)
    except ImportError as error:
        if error.name and error.name != name:  # the plug-in is there, a package that it needs is not
            return MissingDependencyError(feature, error.name, f"pip install {error.name}")
    return MissingDependencyError(feature, name, "docs/install.md lists demorec's plug-ins")


def _batched(observation: dict[str, Any]) -> dict[str, Any]:
    """Add a leading axis of size one."""
    return {
        key: _batched(value) if isinstance(value, dict) else np.ascontiguousarray(value)[np.newaxis]
        for key, value in observation.items()
    }

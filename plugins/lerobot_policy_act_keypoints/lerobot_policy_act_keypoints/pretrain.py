"""Pretraining of the image encoder of a policy.

    OUT/pretraining.json    the settings that decide the result; at the end also the result
    OUT/unfinished.pt       weights and optimizer, until it is done
    OUT/config.json, ...    a policy with the trained encoder: for --policy.path=OUT of lerobot-train

The same command continues where the last one stopped.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.transforms import ImageTransforms, ImageTransformsConfig
from numpy.typing import NDArray
from torch.utils.data import default_collate

from lerobot_policy_act_keypoints.columns import numbers
from lerobot_policy_act_keypoints.errors import RequestError, TrainingError
from lerobot_policy_act_keypoints.files import LOCK_NAME, atomic_write, folder_lock
from lerobot_policy_act_keypoints.keyframes import KeyframeTargets, find_keyframes, keyframe_targets
from lerobot_policy_act_keypoints.modeling_act_keypoints import vocabulary_of
from lerobot_policy_act_keypoints.reader import INTERVENTION, FastDataset, expert_acts

RESULT_NAME, UNFINISHED_NAME = "pretraining.json", "unfinished.pt"
_STATE, _EE_POSE, _ACTION = "observation.state", "observation.ee_pose", "action"
_TCP = ("tcp.x", "tcp.y", "tcp.z", "tcp.qx", "tcp.qy", "tcp.qz", "tcp.qw")
_OPENING = "gripper.width"
_HELD_OUT_RATIO = 0.05
_MAX_EVALUATED_FRAMES = 1000
_WARM_UP_UPDATES = 100
_WEIGHT_DECAY = 1e-3
_MAX_GRADIENT_NORM = 1.0
_LOSS_SMOOTHING = 0.95
_LAST_UPDATES_RATIO = 4
"""Updates of the last part of a training per update of the first part. They cost little, since images are encoded once,
and halve the error of the next keyframe."""
_LAST_BATCH_RATIO = 4
"""Batch size of the last part, per frame of a batch of the first part."""
_NEAR_M = 0.03
"""A frame is drawn in proportion to the distance of its next keyframe plus this, since most frames are near, and easy.
The object that an instruction names is then found after 1,200 updates instead of 3,000."""

Rows = NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class PretrainConfig:
    """Settings of a pretraining.

    Attributes:
        updates: Number of updates of the weights.
        batch_size: Frames of each update, with the images of all cameras.
        learning_rate: Peak; it decays along a cosine.
        seed: Seed of the initial weights and of the drawn frames.
    """

    updates: int = 3000
    batch_size: int = 64
    learning_rate: float = 2e-3
    seed: int = 0


@dataclass(frozen=True, kw_only=True)
class PretrainResult:
    """Errors of the encoder in the held-out episodes, the last twentieth.

    Attributes:
        median_m, most_m: Error of the offset from the TCP to the next keyframe, metres: median and 90th percentile
            over the frames.
        baseline_m: Median error of always predicting the mean offset of the closings, or of the openings.
        episodes: Number of held-out episodes.
        cpu_seconds: CPU time of the last call.
    """

    median_m: float
    most_m: float
    baseline_m: float
    episodes: int
    cpu_seconds: float


def pretrain(
    config: Any,
    plan: PretrainConfig,
    out: Path,
    *,
    frame_cache_bytes: int,
    on_progress: Callable[[str], None],
    save_every: int = 50,
) -> PretrainResult:
    """Train the encoder of a policy and save the policy; continue an unfinished training.

    Args:
        config: TrainPipelineConfig of LeRobot, of which the dataset and the policy are used.
        plan: Settings of the pretraining.
        out: Folder of the policy.
        frame_cache_bytes: Maximum size of the decoded frames that are kept.
        on_progress: Called with a text: the updates done and the smoothed loss.
        save_every: Updates between the states from which a stopped call continues.

    Raises:
        RequestError: The policy is of another type, the dataset has no images or no TCP poses, or the folder is not
            usable.
        TrainingError: A file in the folder is damaged.
    """
    if getattr(config.policy, "type", None) != "act_keypoints":
        raise RequestError("Only the encoder of one type of policy can be pretrained: --policy.type=act_keypoints.")
    chosen = config.dataset
    changes = chosen.image_transforms if chosen.image_transforms.enable else None
    dataset = _opened(chosen, changes, frame_cache_bytes)
    targets = read_targets(dataset)
    if not dataset.meta.camera_keys:
        raise RequestError(f"The dataset has no images to learn from: {dataset.root}")
    settings = {
        **asdict(plan),
        "dataset": _digest(dataset),
        "episodes": chosen.episodes,
        "policy": _deciding(config.policy),
        "image_transforms": changes and json.loads(json.dumps(asdict(changes))),
        "targets": list(targets.names),
    }
    if out.resolve().is_relative_to(Path(dataset.root).resolve()):
        raise RequestError(f"The folder is inside the dataset, choose another --out: {out}")
    with folder_lock(out):
        finished = _settle(out, settings)
        if finished is not None:
            return finished
        training = _EncoderTraining(config.policy, plan, dataset, targets)
        started = time.process_time()
        training.run(out / UNFINISHED_NAME, on_progress, save_every)
        training.finish_targets(on_progress)
        result = training.evaluate(time.process_time() - started)
        training.save(out)
        atomic_write(out / RESULT_NAME, json.dumps({"settings": settings, "result": asdict(result)}, indent=1))
        (out / UNFINISHED_NAME).unlink(missing_ok=True)
        return result


def _opened(chosen: Any, changes: ImageTransformsConfig | None, frame_cache_bytes: int) -> FastDataset:
    return FastDataset(
        chosen.repo_id,
        root=chosen.root,
        episodes=chosen.episodes,
        revision=chosen.revision,
        video_backend=chosen.video_backend,
        image_transforms=changes and ImageTransforms(changes),
        frame_cache_bytes=frame_cache_bytes,
    )


def read_targets(dataset: FastDataset) -> KeyframeTargets:
    """Compute the targets for each row of a dataset.

    Raises:
        RequestError: The dataset lacks the TCP's pose or the commanded opening.
    """
    features = dataset.meta.features
    pose = next((name for name in (_EE_POSE, _STATE) if set(_TCP) <= set(_names(features.get(name)))), None)
    if pose is None or _OPENING not in _names(features.get(_ACTION)):
        missing = f"an action {_OPENING}" if pose else f"{_TCP[0]} to {_TCP[-1]} in {_EE_POSE} or {_STATE}"
        raise RequestError(
            f"The dataset lacks {missing}, so where the hand will grasp is unknown: name the elements so, as "
            f"demorec export lerobot --state joint_ee does: {dataset.root}"
        )
    places = [_names(features[pose]).index(name) for name in _TCP]
    tcp = _column(dataset, pose)[:, places]
    opening = _column(dataset, _ACTION)[:, _names(features[_ACTION]).index(_OPENING)]
    episode = _column(dataset, "episode_index").reshape(-1)
    keyframes = find_keyframes(opening, episode)
    if INTERVENTION in features:  # a keyframe of a policy that was corrected is a mistake
        is_expert = expert_acts(episode, _column(dataset, INTERVENTION))
        keyframes = np.where(is_expert[keyframes], keyframes, -1)
    return keyframe_targets(tcp[:, :3], tcp[:, 3:], keyframes)


class _EncoderTraining:
    """The encoder, its optimizer, and the updates done."""

    def __init__(self, policy: Any, plan: PretrainConfig, dataset: FastDataset, targets: KeyframeTargets) -> None:
        self._plan, self._dataset, self._targets = plan, dataset, targets
        torch.manual_seed(plan.seed)
        policy.num_targets = len(targets.names)
        policy.vocabulary = vocabulary_of(_instructions(dataset))
        self._policy = make_policy(policy, ds_meta=dataset.meta)
        self._before, self._after = make_pre_post_processors(self._policy.config, dataset_stats=dataset.meta.stats)
        self._device = torch.device(policy.device)
        rows = np.flatnonzero(~np.isnan(targets.values).all(1))  # frames after the last keyframe have no target
        training, held_out, self._num_held_out = split(_column(dataset, "episode_index").reshape(-1)[rows])
        self._training, self._held_out = rows[training], rows[held_out]
        values = targets.values[self._training]
        distance = np.linalg.norm(np.take_along_axis(values, targets.offsets[self._training], 1), axis=1) + _NEAR_M
        self._share = distance / distance.sum()
        spread = np.nanstd(values, 0)
        self._mean = np.nanmean(values, 0)
        self._spread = np.where(spread > 1e-4, spread, np.inf).astype(np.float32)
        self._network = self._policy.encoder.requires_grad_(True)
        self._network.normalize_by(dataset.meta.stats, list(self._policy.config.image_features))
        self._optimizer = torch.optim.AdamW(
            self._network.parameters(), lr=plan.learning_rate, weight_decay=_WEIGHT_DECAY
        )
        self._done, self._loss = 0, math.nan

    def run(self, unfinished: Path, on_progress: Callable[[str], None], save_every: int) -> None:
        """Do all updates that are left."""
        if unfinished.exists():
            self._load(unfinished)
        self._network.train()
        while self._done < self._plan.updates:
            loss = self._update()
            self._loss = loss if math.isnan(self._loss) else _LOSS_SMOOTHING * self._loss + (1 - _LOSS_SMOOTHING) * loss
            self._done += 1
            if self._done % save_every == 0 or self._done == self._plan.updates:
                self._store(unfinished)
                on_progress(f"update {self._done:,} of {self._plan.updates:,}, loss {self._loss:.3f}")

    def finish_targets(self, on_progress: Callable[[str], None]) -> None:
        """Train the layers that predict the targets, alone, on frames spread evenly over the dataset.

        A stopped call starts this part again.
        """
        plan, network = self._plan, self._network
        updates = _LAST_UPDATES_RATIO * plan.updates
        batch_size = _LAST_BATCH_RATIO * plan.batch_size
        rows = self._training[:: max(1, len(self._training) // updates)]
        on_progress(f"prediction layers on {len(rows):,} frames, {updates:,} updates of {batch_size}")
        network.eval()
        torch.manual_seed(plan.seed)
        with torch.no_grad():
            parts = [self._encoded(part) for part in np.array_split(rows, math.ceil(len(rows) / plan.batch_size))]
        keypoints, state, _ = (torch.cat(part) for part in zip(*parts, strict=True))
        optimizer = torch.optim.AdamW(
            [*network.linear_targets.parameters(), *network.targets.parameters()],
            lr=plan.learning_rate,
            weight_decay=_WEIGHT_DECAY,
        )
        for update in range(updates):
            chosen = np.random.default_rng([plan.seed, update, 1]).integers(len(rows), size=batch_size)
            at = torch.from_numpy(chosen).to(self._device)
            self._learn(optimizer, update / updates, network.targets_of(keypoints[at], state[at]), rows[chosen])

    def evaluate(self, cpu_seconds: float) -> PretrainResult:
        """Measure the errors on the held-out episodes, without image transforms."""
        self._dataset.clear_image_transforms()
        rows = self._held_out[:: max(1, len(self._held_out) // _MAX_EVALUATED_FRAMES)]
        self._network.eval()
        outputs = []
        with torch.no_grad():
            for start in range(0, len(rows), self._plan.batch_size):
                _, _, predicted = self._encoded(rows[start : start + self._plan.batch_size])
                outputs.append(predicted.cpu().numpy())
        spread = np.where(np.isinf(self._spread), 0, self._spread)
        true, mean = self._targets.values[rows], np.broadcast_to(self._mean, (len(rows), len(self._mean)))
        predicted = np.concatenate(outputs) * spread + mean
        true, predicted, mean = (
            np.take_along_axis(each, self._targets.offsets[rows], 1) for each in (true, predicted, mean)
        )
        error = np.linalg.norm(predicted - true, axis=1)
        return PretrainResult(
            median_m=round(float(np.median(error)), 5),
            most_m=round(float(np.quantile(error, 0.9)), 5),
            baseline_m=round(float(np.median(np.linalg.norm(true - mean, axis=1))), 5),
            episodes=self._num_held_out,
            cpu_seconds=round(cpu_seconds, 1),
        )

    def save(self, out: Path) -> None:
        """Save the policy with the encoder, and its processing steps, as LeRobot's trainings do."""
        for part in (self._policy, self._before, self._after):
            part.save_pretrained(out)

    def _update(self) -> float:
        plan = self._plan
        # The drawn frames depend on the seed and the update alone, so a stopped call continues identically.
        draw = np.random.default_rng([plan.seed, self._done])
        rows = draw.choice(self._training, plan.batch_size, p=self._share)
        torch.manual_seed(plan.seed + self._done)  # for image transforms
        _, _, predicted = self._encoded(rows)
        return self._learn(self._optimizer, self._done / plan.updates, predicted, rows)

    def _learn(self, optimizer: torch.optim.Optimizer, passed: float, predicted: torch.Tensor, rows: Rows) -> float:
        """Do one update by the predictions for some rows; returns its loss. `passed` is the ratio of updates done."""
        plan = self._plan
        wanted = (self._targets.values[rows] - self._mean) / self._spread
        rate = min(1.0, (passed * plan.updates + 1) / _WARM_UP_UPDATES) * 0.5 * (1 + math.cos(math.pi * passed))
        for group in optimizer.param_groups:
            group["lr"] = plan.learning_rate * rate
        is_known = torch.from_numpy(~np.isnan(wanted)).to(self._device)
        error = predicted - torch.from_numpy(np.nan_to_num(wanted)).to(self._device)
        # Closings count as much as openings, which are ahead for longer.
        loss = ((error.abs() * is_known).sum(0) / is_known.sum(0).clamp(min=1)).mean()
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(
            [w for group in optimizer.param_groups for w in group["params"]], _MAX_GRADIENT_NORM
        )
        optimizer.step()
        return float(loss.item())

    def _encoded(self, rows: Rows) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Encode rows: keypoints, state, and the predicted normalised targets (B, K)."""
        batch = self._before(default_collate(self._dataset.__getitems__(rows.tolist())))
        images = [batch[key] for key in self._policy.config.image_features]
        keypoints, predicted = self._network(images, batch[_STATE], batch["task"])
        return keypoints, batch[_STATE], predicted

    def _store(self, path: Path) -> None:
        state = {
            "network": self._network.state_dict(),
            "optimizer": self._optimizer.state_dict(),
            "done": self._done,
            "loss": self._loss,
        }
        part = path.with_suffix(".part")
        with part.open("wb") as file:
            torch.save(state, file)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)

    def _load(self, path: Path) -> None:
        try:
            state = torch.load(path, map_location=self._device, weights_only=True)  # tensors and numbers, no code
            self._network.load_state_dict(state["network"])
            self._optimizer.load_state_dict(state["optimizer"])
            self._done, self._loss = int(state["done"]), float(state["loss"])
        except Exception as error:  # any error of torch
            raise TrainingError(f"The unfinished training is damaged, delete it to start again: {path}") from error


def split(episode: NDArray[np.integer]) -> tuple[Rows, Rows, int]:
    """Split rows into training rows and held-out rows (the last twentieth of the episodes, at least one).

    Returns the number of held-out episodes, too.

    Raises:
        RequestError: There are fewer than two episodes.
    """
    numbers_of = np.unique(episode)
    if len(numbers_of) < 2:
        raise RequestError(
            f"The gripper is commanded to close or to open in {len(numbers_of)} of the dataset's episodes: at least 2 "
            "are needed, one of which is held out."
        )
    count = max(1, round(_HELD_OUT_RATIO * len(numbers_of)))
    is_held_out = np.isin(episode, numbers_of[-count:])
    return np.flatnonzero(~is_held_out), np.flatnonzero(is_held_out), count


def _settle(out: Path, settings: dict[str, Any]) -> PretrainResult | None:
    """Write the settings, or compare them with the existing ones; returns the result of a finished pretraining."""
    path = out / RESULT_NAME
    if not path.exists():
        if strangers := [each.name for each in out.iterdir() if each.name != LOCK_NAME]:
            raise RequestError(f"The folder holds something else ({strangers[0]}), choose another --out: {out}")
        atomic_write(path, json.dumps({"settings": settings}, indent=1))
        return None
    try:
        written = json.loads(path.read_text())
        result = PretrainResult(**written["result"]) if "result" in written else None
        others = sorted(name for name in settings if written["settings"].get(name) != settings[name])
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise TrainingError(f"{RESULT_NAME} is damaged, delete the folder to start again: {path}") from error
    if others:
        raise RequestError(
            f"Another encoder is pretrained in this folder (another {', another '.join(others)}), choose another "
            f"--out: {out}"
        )
    return result


def _deciding(policy: Any) -> dict[str, Any]:
    """The policy's settings that decide the encoder and the saved policy."""
    plain: dict[str, Any] = json.loads(json.dumps(asdict(policy), default=str))
    return {name: value for name, value in plain.items() if name not in ("device", "pretrained_path")}


def _digest(dataset: FastDataset) -> str:
    """Digest of the dataset's statistics, which identifies it."""
    path = Path(dataset.root) / "meta" / "stats.json"
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def _instructions(dataset: FastDataset) -> list[str]:
    """Distinct instructions of the dataset's episodes."""
    tasks = dataset.meta.tasks.index.tolist()
    return [tasks[number] for number in np.unique(_column(dataset, "task_index"))]


def _column(dataset: FastDataset, name: str) -> NDArray[Any]:
    table = dataset.hf_dataset.with_format("arrow").select_columns([name])[:]
    column = numbers(table.column(name))
    if column is None:
        raise RequestError(f"The feature {name} of the dataset holds more than numbers: {dataset.root}")
    return column.take(np.arange(len(column)))


def _names(feature: Any) -> list[str]:
    names = (feature or {}).get("names")
    return names if isinstance(names, list) else []

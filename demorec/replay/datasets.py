"""Episodes of an exported dataset as demonstrations: float32 actions of any kind, the scene from the sidecar."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from demorec.errors import ConfigError
from demorec.replay.demonstration import Demonstration, ReplayOptions
from demorec.scene.features import ACTION, STATE


def dataset_demonstrations(
    path: Path, wanted: Callable[[int], bool], options: ReplayOptions, *, limit: int | None = None
) -> Iterator[Demonstration]:
    """The episodes of an exported dataset, by what its sidecar keeps of their scenes.

    Args:
        path: The dataset.
        wanted: Whether an episode, by its number in the dataset, is wanted.
        options: How it will be replayed.
        limit: No more than this many, spread evenly.

    Raises:
        ConfigError: The dataset has no sidecar of ours, other actions, or the options make no sense for it.
        ExportError: It is damaged.
    """
    from demorec.check.dataset import Dataset

    if options.states or options.export_hz:
        raise ConfigError("--states and --export-hz are for recordings: a dataset has no full states and one rate.")
    dataset = Dataset(path)
    if not dataset.sidecar:
        raise ConfigError(f"The dataset does not say how its scenes were (no demorec/episodes): {path}")
    dataset.check_simulated()
    chosen = [each for each in dataset.described() if wanted(each.number)]
    if limit is not None and len(chosen) > limit:
        chosen = [chosen[k * len(chosen) // limit] for k in range(limit)]
    for each in chosen:
        number, rows, row, info = each.number, each.rows, each.kept, each.info
        kind = dataset.action_kind(info)
        if kind is None:
            raise ConfigError(f"The dataset's actions are none that demorec writes, so they cannot be replayed: {path}")
        state, arm = rows[STATE].astype(np.float64), len(info.robot.arm_joints)
        yield Demonstration(
            name=f"{path.name}_episode_{number:06d}",
            info=info,
            fps=dataset.info.fps,
            actions=rows[ACTION].astype(np.float64),
            action_kind=kind,
            joint_position=state[:, :arm],
            joint_velocity=None,
            gripper_width=state[:, arm],
            object_poses={},
            recorded_success=bool(row["success"]),
            tolerance=1e-6,
            digest=str(row["content_digest"]),
        )

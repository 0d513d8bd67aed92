"""Data that a policy learns from corrected episodes with the expert's frames only."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lerobot_datasets import DELTA_NAMES, TCP_NAMES

from lerobot_policy_act_keypoints.errors import RequestError


def write(root: Path, *episodes: Sequence[bool], openings: Sequence[float] = (), corrected: bool = True) -> Path:
    """Write episodes, each given by whether an expert took over from a policy in its frames."""
    from lerobot.datasets import LeRobotDataset

    features: dict[str, Any] = {
        "observation.ee_pose": {"dtype": "float32", "shape": (7,), "names": TCP_NAMES},
        "action": {"dtype": "float32", "shape": (7,), "names": [*DELTA_NAMES, "gripper.width"]},
    }
    if corrected:
        features["intervention"] = {"dtype": "bool", "shape": (1,), "names": None}
    dataset = LeRobotDataset.create("local/d", 30, features, root=root, use_videos=False)
    for number, acts in enumerate(episodes):
        for t, act in enumerate(acts):
            action = np.array([number, t, 0, 0, 0, 0, openings[t % len(openings)] if openings else 0.08], np.float32)
            frame = {"observation.ee_pose": np.array([t, 0, 0, 1, 0, 0, 0], np.float32), "action": action, "task": "go"}
            dataset.add_frame(frame | ({"intervention": np.array([act])} if corrected else {}))
        dataset.save_episode()
    dataset.finalize()
    return root


DEMONSTRATION = [False] * 6
CORRECTED = [False, False, False, True, True, False, False, False, True]


def test_a_dataset_shows_the_expert_alone(tmp_path: Path) -> None:
    from lerobot_policy_act_keypoints import FastDataset

    write(tmp_path / "d", DEMONSTRATION, CORRECTED)
    settings: dict[str, Any] = {"delta_timestamps": {"action": [0.0, 1 / 30, 2 / 30]}}
    everything = FastDataset("local/d", root=tmp_path / "d", **settings)
    experts = FastDataset("local/d", root=tmp_path / "d", expert_only=True, **settings)
    assert len(experts) == len(everything) == 15
    of_expert = {0, 1, 2, 3, 4, 5, 9, 10, 14}
    for item in (experts[index] for index in range(15)):
        assert int(item["index"]) in of_expert
    assert experts[9]["action_is_pad"].tolist() == [False, False, True]  # the policy continues there
    assert everything[9]["action_is_pad"].tolist() == [False, False, False]
    assert experts[9]["action"][2].tolist() == everything[10]["action"][0].tolist()  # held, as at an episode's end
    assert experts[0]["action_is_pad"].tolist() == [False, False, False]
    write(tmp_path / "silent", DEMONSTRATION, corrected=False)
    with pytest.raises(RequestError, match="--intervention"):
        FastDataset("local/d", root=tmp_path / "silent", expert_only=True)


def test_where_a_policy_closed_and_was_corrected_is_no_keyframe(tmp_path: Path) -> None:
    from lerobot_policy_act_keypoints import FastDataset
    from lerobot_policy_act_keypoints.pretrain import read_targets

    closes_and_opens = [0.08, 0.08, 0.0, 0.0, 0.08, 0.08]
    corrected = [False] * 4 + [True] * 8  # first the policy closes
    ahead = {}
    for name in ("d", "silent"):
        root = write(tmp_path / name, DEMONSTRATION, corrected, openings=closes_and_opens, corrected=name == "d")
        targets = read_targets(FastDataset("local/d", root=root))
        columns = [targets.names.index(f"{command}.x") for command in ("closing", "opening")]
        ahead[name] = ~np.isnan(targets.values[:, columns])
    demonstration = [[1, 1], [1, 1], [0, 1], [0, 1], [0, 0], [0, 0]]
    closing = [0, 0, *[1] * 6, *[0] * 4]
    opening = [1] * 10 + [0] * 2
    assert ahead["d"].astype(int).tolist() == [*demonstration, *map(list, zip(closing, opening, strict=True))]
    assert ahead["silent"][6:, 0].astype(int).tolist() == [1, 1, *closing[2:]]

"""What of corrected episodes a policy learns from, when it learns from the expert alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.export import export
from support.recording import make_episode

from demorec.core.errors import ConfigError
from demorec.mcap import EpisodeWriter


def write(path: Path, episode_index: int, phases: Sequence[str], openings: Sequence[float] | None = None) -> None:
    info, frames, outcome = make_episode(num_frames=len(phases), cameras=(), episode_index=episode_index)
    with EpisodeWriter(path, info) as writer:
        for number, (frame, phase) in enumerate(zip(frames, phases, strict=True)):
            action = replace(frame.action, gripper_target=openings[number]) if openings else frame.action
            writer.write(replace(frame, phase=phase, action=action))
        writer.finish(outcome)


@pytest.mark.usefixtures("hf_datasets_cache")
def test_a_dataset_shows_the_expert_alone(tmp_path: Path) -> None:
    from demorec.learn.training import FastDataset

    policy = ["policy"] * 3
    (tmp_path / "run").mkdir()
    for number, phases in enumerate((["expert"] * 6, [*policy, "expert", "expert", *policy, "expert"])):
        write(tmp_path / "run" / f"episode_{number:06d}.mcap", number, phases)
    export(tmp_path / "run", tmp_path / "d", intervention=True)
    settings: dict[str, Any] = {"delta_timestamps": {"action": [0.0, 1 / 30, 2 / 30]}}
    everything = FastDataset("local/d", root=tmp_path / "d", **settings)
    experts = FastDataset("local/d", root=tmp_path / "d", expert_only=True, **settings)
    assert len(experts) == len(everything) == 15
    of_expert = {0, 1, 2, 3, 4, 5, 9, 10, 14}
    for item in (experts[index] for index in range(15)):
        assert int(item["index"]) in of_expert
    assert experts[9]["action_is_pad"].tolist() == [False, False, True]  # the policy goes on there
    assert everything[9]["action_is_pad"].tolist() == [False, False, False]
    assert experts[9]["action"][2].tolist() == everything[10]["action"][0].tolist()  # held, as at an episode's end
    assert experts[0]["action_is_pad"].tolist() == [False, False, False]
    export(tmp_path / "run", tmp_path / "silent")
    with pytest.raises(ConfigError, match="--intervention"):
        FastDataset("local/d", root=tmp_path / "silent", expert_only=True)


@pytest.mark.usefixtures("hf_datasets_cache")
def test_where_a_policy_closed_and_was_corrected_is_nothing_to_see(tmp_path: Path) -> None:
    from demorec.learn.training import FastDataset
    from demorec.learn.training.pretrain import read_targets

    (tmp_path / "run").mkdir()
    closes_and_opens = [0.08, 0.08, 0.0, 0.0, 0.08, 0.08]
    phases = ["policy"] * 4 + ["expert"] * 8
    write(tmp_path / "run" / "episode_000000.mcap", 0, phases[4:10], closes_and_opens)
    write(tmp_path / "run" / "episode_000001.mcap", 1, phases, closes_and_opens * 2)  # first the policy closes
    choice: dict[str, Any] = {"action": "ee_delta", "state": "joint_ee"}
    export(tmp_path / "run", tmp_path / "d", intervention=True, **choice)
    export(tmp_path / "run", tmp_path / "silent", **choice)
    ahead = {}
    for name in ("d", "silent"):
        targets = read_targets(FastDataset("local/d", root=tmp_path / name))
        columns = [targets.names.index(f"{command}.x") for command in ("closing", "opening")]
        ahead[name] = ~np.isnan(targets.values[:, columns])
    demonstration = [[1, 1], [1, 1], [0, 1], [0, 1], [0, 0], [0, 0]]
    closing = [0, 0, *[1] * 6, *[0] * 4]
    opening = [1] * 10 + [0] * 2
    assert ahead["d"].astype(int).tolist() == [*demonstration, *map(list, zip(closing, opening, strict=True))]
    assert ahead["silent"][6:, 0].astype(int).tolist() == [1, 1, *closing[2:]]

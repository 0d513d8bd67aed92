"""What of corrected episodes a policy learns from, when it learns from the expert alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from support.export import export
from support.recording import make_episode

from demorec.core.errors import ConfigError
from demorec.mcap import EpisodeWriter


def write(path: Path, episode_index: int, phases: Sequence[str]) -> None:
    info, frames, outcome = make_episode(num_frames=len(phases), cameras=(), episode_index=episode_index)
    with EpisodeWriter(path, info) as writer:
        for frame, phase in zip(frames, phases, strict=True):
            writer.write(replace(frame, phase=phase))
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

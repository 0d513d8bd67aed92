"""Frames that do not fit their episode are refused when they are written, in a sentence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.recording import make_episode

from demorec.core.errors import RecordingError
from demorec.episode.episode import Frame
from demorec.mcap import EpisodeWriter


def observed(frame: Frame, **changes: Any) -> Frame:
    return replace(frame, observation=replace(frame.observation, **changes))


def moved(frame: Frame, **changes: Any) -> Frame:
    return replace(frame, command=replace(frame.command, **changes))


def with_nan(values: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    return np.append(values[:-1], np.nan)


FAULTS: dict[str, tuple[Callable[[Frame], Frame], str]] = {
    "seven joints for nine": (
        lambda f: observed(f, joint_position=f.observation.joint_position[:7]),
        "25 numbers for /joint_states, it must have 27",
    ),
    "a NaN in a command": (
        lambda f: moved(f, joint_target=with_nan(f.command.joint_target)),
        "a number for /command that is not finite",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_frame_that_does_not_fit_is_refused_at_once(fault: str, tmp_path: Path) -> None:
    info, frames, _ = make_episode(num_frames=4, cameras=("front",))
    spoil, words = FAULTS[fault]
    with EpisodeWriter(tmp_path / "e.mcap", info) as writer:
        for frame in frames[:2]:
            writer.write(frame)
        with pytest.raises(RecordingError, match=f"^Frame 2 has .*{words}"):
            writer.write(spoil(frames[2]))

"""External episodes: invalid values are refused before a file is made."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from support.external import (
    STATE,
    TOP,
    make_external,
)

from demorec.core.errors import ConfigError
from demorec.episode.info import EpisodeInfo
from demorec.extensions.recorder.sampled_writer import SampledWriter


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"fps": 0}, "fps is 0"),
        ({"instruction": " "}, "task text is empty"),
        ({"features": ()}, "there are no features"),
        ({"features": (STATE, STATE)}, "2 features are called 'observation.state'"),
        ({"features": (replace(STATE, name="tf.x"),)}, "reserved"),
        ({"features": (replace(STATE, name="timestamp"),)}, "reserved"),
        ({"features": (replace(STATE, name="a/b"),)}, "allowed are words"),
        ({"features": (replace(STATE, units=("rad",)),)}, "3 elements, but 1 units"),
        ({"features": (replace(STATE, joints=("shoulder", "wrist", "")),)}, "URDF lacks: wrist"),
        ({"features": (replace(STATE, names=("a", "a", "b")),)}, "are called 'a'"),
        ({"cameras": (replace(TOP, name="my top"),)}, "allowed are letters"),
        ({"cameras": (replace(TOP, width=0),)}, "0x48 pixels"),
        ({"cameras": (replace(TOP, mount="nowhere"),)}, "not a link of the URDF"),
        ({"urdf": "<robot"}, "not valid XML"),
    ],
)
def test_an_impossible_description_is_refused(tmp_path: Path, changes: dict[str, Any], words: str) -> None:
    info: EpisodeInfo = replace(make_external(num_frames=1).info, **changes)
    with pytest.raises(ConfigError, match=words):
        SampledWriter(tmp_path / "a.mcap", info)
    assert not list(tmp_path.iterdir())

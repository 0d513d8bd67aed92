"""Plain data keeps every bit, and unknown fields are refused."""

from __future__ import annotations

import pytest
from support.recording import make_episode

from demorec.core.plain import from_json, to_json
from demorec.episode.scene import Scene


def test_unknown_keys_are_named_with_their_place() -> None:
    text = to_json(make_episode(num_frames=1)[0].simulated.scene).replace('"mass"', '"mas"')
    with pytest.raises(ValueError, match=r"extra fields found \(mas\).*bodies\[0\]"):
        from_json(text, Scene)

"""Plain data keeps every bit and refuses what it does not know."""

from __future__ import annotations

import pytest
from support.recording import make_episode

from demorec.core.plain import from_json, from_plain, to_json, to_plain
from demorec.episode.scene import (
    CONTACT_BREAKING_THRESHOLD,
    FINGER_STIFFNESS,
    Physics,
    Scene,
)


def test_unknown_keys_are_named_with_their_place() -> None:
    text = to_json(make_episode(num_frames=1)[0].scene).replace('"mass"', '"mas"')
    with pytest.raises(ValueError, match=r"extra fields found \(mas\).*bodies\[0\]"):
        from_json(text, Scene)


@pytest.mark.parametrize(
    ("name", "before", "now"),
    [
        ("contact_breaking_threshold", 0.02, CONTACT_BREAKING_THRESHOLD),
        ("finger_stiffness", 30_000.0, FINGER_STIFFNESS),
    ],
)
def test_physics_says_of_contacts_only_what_is_not_that_of_older_recordings(
    name: str, before: float, now: float
) -> None:
    """Recordings from before a field keep their digests, and are simulated as they were."""
    assert name not in to_plain(Physics())
    assert getattr(from_plain(to_plain(Physics()), Physics), name) == before != now
    new = from_plain(to_plain(Physics()) | {name: now}, Physics)
    assert getattr(new, name) == now
    assert to_plain(new)[name] == now

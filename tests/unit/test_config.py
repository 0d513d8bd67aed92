"""Impossible configs: one clear sentence each, with the allowed values."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError
from typing import Any

import pytest

from demorec.core.config import (
    GenerateConfig,
    VideoConfig,
    _deciding_versions,
    deciding_versions,
)
from demorec.core.errors import ConfigError


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fps": 50}, "use 48 or 60"),
        ({"fps": 300}, "use 240"),
        ({"height": 0}, "height is 0"),
        ({"width": 8000, "height": 8000}, "pixels per image"),
        ({"video": VideoConfig(crf=99)}, "crf is 99"),
        ({"video": VideoConfig(codec="jpeg", jpeg_quality=0)}, "quality is 0"),
        ({"video": VideoConfig(preset="nope")}, "preset is 'nope', h264 has ultrafast, superfast"),
        ({"video": VideoConfig(codec="av1", preset="medium")}, "preset is 'medium', av1 has 0, 1"),
        ({"video": VideoConfig(codec="jpeg", preset="fast")}, "jpeg has none"),
    ],
)
def test_impossible_values_are_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        GenerateConfig(**change).validate()


def test_the_fork_that_replaces_pybullet_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def version(name: str) -> str:
        if name == "pybullet":
            raise PackageNotFoundError(name)
        return "3.2.8"

    monkeypatch.setattr("demorec.core.config.version", version)
    monkeypatch.setattr("demorec.core.config._deciding_versions", _deciding_versions.__wrapped__)
    assert deciding_versions()["pybullet"] == "3.2.8 (pybullet-arm64)"

"""The renderer that is kept from one recording to the next."""

from __future__ import annotations

from typing import ClassVar

import pytest

from demorec.core.errors import ConfigError
from demorec.core.geometry import Array
from demorec.core.registry import Registry
from demorec.episode.episode import CameraImages
from demorec.render import Renderer, RenderSetup, painter
from demorec.render.painter import WarmRenderer


class Counted:
    """A renderer that draws nothing and is counted."""

    opened: ClassVar[list[Counted]] = []

    def __init__(self) -> None:
        self.is_open = False
        self.opened.append(self)

    def setup(self, setup: RenderSetup) -> None: ...

    def render(self, poses: Array) -> dict[str, CameraImages]:
        return {}

    def close(self) -> None:
        self.is_open = False

    def __enter__(self) -> Counted:
        self.is_open = True
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[Counted]:
    """Every renderer that was made; the table has the rows "a" and "b"."""
    monkeypatch.setattr(Counted, "opened", [])
    place = f"{__name__}:Counted"
    rows: Registry[type[Renderer]] = Registry("renderer", {"a": place, "b": place})
    monkeypatch.setattr(painter, "RENDERERS", rows)
    return Counted.opened


def test_one_renderer_serves_until_another_is_asked_for(opened: list[Counted]) -> None:
    with WarmRenderer() as renderers:
        first = renderers.of("a")
        assert renderers.of("a") is first
        assert [renderer.is_open for renderer in opened] == [True]
        assert renderers.of("b") is not first
        assert [renderer.is_open for renderer in opened] == [False, True]
    assert [renderer.is_open for renderer in opened] == [False, False]


def test_an_unknown_renderer_is_refused_and_nothing_stays_open(opened: list[Counted]) -> None:
    with WarmRenderer() as renderers:
        renderers.of("a")
        with pytest.raises(ConfigError, match="c"):
            renderers.of("c")
    assert [renderer.is_open for renderer in opened] == [False]

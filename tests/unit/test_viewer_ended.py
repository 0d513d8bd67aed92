"""Messages when Rerun's headless viewer ends by itself."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from support.external import make_external, write_external
from support.viewer import need_vulkan

from demorec.cli import run_command
from demorec.cli.view import View
from demorec.core.errors import DemorecError
from demorec.view.viewer import why_it_ended


@pytest.mark.slow
@pytest.mark.viewer
def test_a_character_without_a_glyph_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    need_vulkan()
    given = make_external()
    write_external(tmp_path / "x.mcap", replace(given, info=replace(given.info, instruction="一")))
    arguments = [str(tmp_path / "x.mcap"), "--screenshot", str(tmp_path / "x.png")]
    assert run_command(View, arguments, prog="demorec view") == 1
    assert "cannot draw '一' (U+4E00), which the file contains" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["x.mcap"]


NO_DRIVER = """libEGL warning: MESA-LOADER: failed to open swrast
thread 'main' panicked at 'Failed to create render state: CustomNativeAdapterSelectionError("No adapter found")'
egui_kittest-0.37.0/src/wgpu.rs:77
"""
NO_VULKAN = """WARN egui_wgpu: Software rasterizer detected. backend: Gl
thread 'main' panicked at 'Failed to get render context'
re_viewer/src/app/mod.rs:1425
"""
OTHER = """WARN Vulkan: adapter llvmpipe
thread 'main' panicked at 'index out of bounds'
  13: table<core::iter::adapters::enumerate::Enumerate>
"""


@pytest.mark.parametrize(
    ("said", "words", "is_driver"),
    [
        (NO_DRIVER, "mesa-vulkan-drivers", True),
        (NO_VULKAN, "mesa-vulkan-drivers", True),
        (OTHER, "ended by itself: index out of bounds", False),
        ("error: the port is taken\n", "ended by itself: error: the port is taken", False),
    ],
)
def test_a_missing_driver_is_reported_only_by_the_viewers_message(said: str, words: str, is_driver: bool) -> None:
    error = why_it_ended(said)
    assert isinstance(error, DemorecError)
    assert words in str(error)
    assert ("mesa-vulkan-drivers" in str(error)) == is_driver

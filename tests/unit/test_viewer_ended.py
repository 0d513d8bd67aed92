"""Messages when Rerun's headless viewer ends by itself."""

from __future__ import annotations

import pytest

from demorec.core.errors import DemorecError
from demorec.view.viewer import why_it_ended

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

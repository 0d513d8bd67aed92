"""PyBullet's OpenGL renderer without a window (EGL plugin): fast on a GPU, needs libEGL."""

from __future__ import annotations

import functools
import importlib.util
import subprocess
import sys
from typing import Any

from demorec.core.errors import RenderError
from demorec.core.geometry import Array
from demorec.episode.episode import CameraImages
from demorec.sim.renderers.client_renderer import ClientRenderer

_PROBE = """
import sys, pybullet
pybullet.connect(pybullet.DIRECT)
plugin = pybullet.loadPlugin(sys.argv[1], "_eglRendererPlugin")
if plugin < 0:
    sys.exit(3)
pybullet.getCameraImage(16, 16, renderer=pybullet.ER_BULLET_HARDWARE_OPENGL)
print("egl works")
"""


@functools.cache
def _plugin_path() -> str:
    spec = importlib.util.find_spec("eglRenderer")
    if spec is None or spec.origin is None:
        raise RenderError("This PyBullet was built without its EGL renderer: use --renderer raster or tiny.")
    return spec.origin


@functools.cache
def probe() -> str:
    """ "" when the plugin works here, else why not; tried in a process of its own, which it kills without libEGL."""
    try:
        result = subprocess.run(
            [sys.executable, "-c", _PROBE, _plugin_path()], capture_output=True, text=True, timeout=120, check=False
        )
    except subprocess.TimeoutExpired:
        return "no answer within 120 s"
    if result.returncode == 0 and "egl works" in result.stdout:
        return ""
    lines = [line for line in (result.stdout + result.stderr).splitlines() if line.strip()]
    return lines[-1] if lines else f"exit status {result.returncode}"


class EglRenderer(ClientRenderer):
    """Draws through OpenGL; one per process, or a client's pictures are silently wrong.

    Raises:
        RenderError: The plugin does not work on this machine.
    """

    constant = "ER_BULLET_HARDWARE_OPENGL"

    def __init__(self) -> None:
        super().__init__()
        reason = probe()
        if reason:
            raise RenderError(
                f"The EGL renderer does not work here ({reason}): install libegl1 (on Debian: apt-get install libegl1 "
                "libgl1-mesa-dri), or use --renderer raster or tiny."
            )
        self._plugin = -1
        self._is_first_picture = True

    def _connect(self) -> Any:
        client = super()._connect()
        self._plugin = client.loadPlugin(_plugin_path(), "_eglRendererPlugin")
        if self._plugin < 0:
            client.disconnect()
            raise RenderError("The EGL renderer could not be loaded into PyBullet: use --renderer raster.")
        self._is_first_picture = True
        return client

    def _disconnect(self, client: Any) -> None:
        if client.isConnected():
            client.unloadPlugin(self._plugin)
            super()._disconnect(client)

    def render(self, poses: Array) -> dict[str, CameraImages]:
        """As `ClientRenderer.render`."""
        if self._is_first_picture:  # it differs from all later ones in some pixels
            super().render(poses)
            self._is_first_picture = False
        return super().render(poses)

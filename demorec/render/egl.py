"""PyBullet's OpenGL renderer without a window (EGL plugin): fast on a GPU, needs libEGL."""

from __future__ import annotations

import functools
import importlib.util
import subprocess
import sys
from dataclasses import replace
from typing import Any, Self

from demorec.episode import CameraImages
from demorec.errors import RenderError
from demorec.render import RenderSetup
from demorec.render.mirror import SceneMirror
from demorec.render.setup_checks import check_setup
from demorec.render.tiny import draw, require_numpy

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


class EglRenderer:
    """Draws a copy of the scene in a client of its own; one per process, or a client's pictures are silently wrong."""

    def __init__(self) -> None:
        reason = probe()
        if reason:
            raise RenderError(
                f"The EGL renderer does not work here ({reason}): install libegl1 (on Debian: apt-get install libegl1 "
                "libgl1-mesa-dri), or use --renderer raster or tiny."
            )
        self._setup: RenderSetup | None = None
        self._client: Any = None
        self._mirror: SceneMirror | None = None
        self._plugin = -1

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def close(self) -> None:
        """Unload the plugin; harmless when called twice."""
        if self._client is not None and self._client.isConnected():
            self._client.unloadPlugin(self._plugin)
            self._client.disconnect()
        self._client = self._setup = self._mirror = None

    def setup(self, setup: RenderSetup) -> None:
        """Take over a freshly built scene; RenderError when the plugin or a shape cannot be loaded."""
        require_numpy(setup.client)
        check_setup(setup)
        first = self._client is None
        if first:
            client = type(setup.client)(setup.client.DIRECT)
            self._plugin = client.loadPlugin(_plugin_path(), "_eglRendererPlugin")
            if self._plugin < 0:
                client.disconnect()
                raise RenderError("The EGL renderer could not be loaded into PyBullet: use --renderer raster.")
            self._client = client
        self._setup = setup
        self._mirror = SceneMirror(self._client, setup)
        if first:
            self.render()  # the plugin's first picture differs from all later ones in some pixels

    def render(self) -> dict[str, CameraImages]:
        """Camera name -> images of the present state."""
        setup = self._setup
        if setup is None or self._mirror is None:
            raise RuntimeError("the renderer has no scene: call setup first")
        if not self._mirror.is_current():
            self._mirror = SceneMirror(self._client, setup)  # a colour, texture or shape was changed
        self._mirror.follow()
        result = {}
        for camera in setup.cameras:
            images = draw(setup, camera, renderer=self._client.ER_BULLET_HARDWARE_OPENGL, client=self._client)
            labels = images.segmentation
            result[camera.name] = (
                images if labels is None else replace(images, segmentation=self._mirror.original_labels(labels))
            )
        return result

"""Drive the real viewers: their requirements, the reason for a skipped test, and the assessment of an image."""

from __future__ import annotations

import base64
import contextlib
import io
import json
import os
import shutil
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import numpy as np
import pytest
import rerun_cli
from numpy.typing import NDArray
from PIL import Image
from rerun.experimental import ViewerClient

from demorec.view.paths import SECONDS
from demorec.view.viewer import viewer_environment

VULKAN_DRIVERS = Path("/usr/share/vulkan/icd.d")


def need(missing: bool, reason: str) -> None:
    """Skip with the reason; in CI, where everything is installed, fail."""
    if missing and os.environ.get("CI") == "true":
        pytest.fail(f"CI lacks a requirement of this test: {reason}")
    if missing:
        pytest.skip(reason)


def need_vulkan() -> None:
    found = VULKAN_DRIVERS.is_dir() and any(VULKAN_DRIVERS.glob("*.json"))
    need(not found, "no Vulkan driver (apt-get install mesa-vulkan-drivers)")


def need_chromium() -> str:
    program = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    need(program is None, "no Chromium (apt-get install chromium)")
    assert program is not None
    return program


def pixels(png: bytes) -> NDArray[np.uint8]:
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))


def num_colors(image: NDArray[np.uint8]) -> int:
    return len(np.unique(image.reshape(-1, 3) // 8, axis=0))


@contextlib.contextmanager
def rerun_viewer(file: Path) -> Iterator[RerunViewer]:
    """Show an .rrd file in Rerun's viewer without a screen."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    program = str(Path(rerun_cli.__file__).with_name("rerun"))
    flags = ["--headless", "--bind", "127.0.0.1", "--port", str(port), "--window-size", "1600x950"]
    process = subprocess.Popen([program, *flags, str(file)], env=viewer_environment(), stderr=subprocess.DEVNULL)
    try:
        yield RerunViewer(port, process)
    finally:
        process.kill()
        process.wait()


class RerunViewer:
    """A viewer that has loaded its file."""

    def __init__(self, port: int, process: subprocess.Popen[bytes]) -> None:
        deadline = time.monotonic() + 60
        while True:
            assert process.poll() is None, "the viewer has ended"
            assert time.monotonic() < deadline, "the viewer has not loaded the file"
            time.sleep(0.2)
            with contextlib.suppress(OSError, RuntimeError, ValueError):
                self.client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
                state = self.client.get_state()
                if not state.loading and any(recording.timelines for recording in state.recordings):
                    return

    def seek(self, seconds: float) -> None:
        """Pause at a time, until the image no longer changes (videos are decoded)."""
        for recording in self.client.get_state().recordings:
            self.client.set_time(timeline=SECONDS, duration=seconds, play_state="paused", recording=recording.store_id)
        before, same, deadline = b"", 0, time.monotonic() + 30
        while same < 3 and time.monotonic() < deadline:
            time.sleep(0.4)
            now = bytes(self.client.take_screenshot())
            before, same = now, same + 1 if now == before else 0

    def view_image(self, name: str) -> NDArray[np.uint8]:
        """Pixels of one view."""
        (number,) = (view.view_id for view in self.client.get_state().views if view.name == name)
        return pixels(bytes(self.client.take_screenshot(number)))

    def reports(self) -> list[tuple[str, Any]]:
        """Every warning and error of a view: (its name, Rerun's report)."""
        return [(view.name, report) for view in self.client.get_state().views for report in view.reports]


@contextlib.contextmanager
def chromium(program: str, address: str) -> Iterator[Chromium]:
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        process = subprocess.Popen(
            [
                program, "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
                "--disable-background-networking", "--disable-component-update", "--disable-sync",
                "--enable-unsafe-swiftshader", "--remote-debugging-port=0", "--remote-allow-origins=*",
                "--window-size=1400,900", f"--user-data-dir={profile}", address,
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )  # fmt: skip
        try:
            yield Chromium(Path(profile), process)
        finally:
            process.terminate()
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


class Chromium:
    """A page in headless Chromium, controlled by the DevTools protocol."""

    def __init__(self, profile: Path, process: subprocess.Popen[bytes]) -> None:
        from websocket import create_connection

        deadline = time.monotonic() + 60
        port_file = profile / "DevToolsActivePort"
        while not port_file.is_file():
            assert process.poll() is None, "Chromium ended at once"
            assert time.monotonic() < deadline, "Chromium does not come up"
            time.sleep(0.1)
        port = port_file.read_text().split()[0]
        with urlopen(f"http://127.0.0.1:{port}/json") as answer:
            page = next(target for target in json.load(answer) if target["type"] == "page")
        self._socket = create_connection(page["webSocketDebuggerUrl"], timeout=60)
        self._number = 0

    def call(self, method: str, **parameters: object) -> dict[str, Any]:
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._socket.recv())
            if answer.get("id") == self._number:
                assert "error" not in answer, answer
                result: dict[str, Any] = answer["result"]
                return result

    def value(self, expression: str) -> Any:
        answer = self.call("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def image(self) -> bytes:
        return base64.b64decode(self.call("Page.captureScreenshot")["data"])

"""Drive the real viewers: their requirements, the reason for a skipped test, and the assessment of an image."""

from __future__ import annotations

import base64
import contextlib
import io
import json
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

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

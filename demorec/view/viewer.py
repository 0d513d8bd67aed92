"""Rerun's viewer, with the ffmpeg that it needs for H.264: in a window, without a screen, or in the browser."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from urllib.parse import quote
from urllib.request import urlopen

from rerun.experimental import ViewerClient

from demorec.core.errors import ConfigError, MissingDependencyError, RecordingError
from demorec.core.files import cache_folder
from demorec.core.processes import start_program
from demorec.view.paths import SECONDS

_START_SECONDS = 60.0
_SETTLE_SECONDS = 30.0
_END_SECONDS = 5.0


def _start_viewer(*arguments: str, **options: Any) -> subprocess.Popen[Any]:
    """Start the viewer, reachable only from this machine; `options` are those of `start_program`."""
    import rerun_cli

    program = Path(rerun_cli.__file__).with_name("rerun")  # its version matches the recordings
    if not program.is_file():
        raise MissingDependencyError("Showing recordings", "rerun-sdk", "pip install 'rerun-sdk>=0.41,<0.42'")
    return start_program([str(program), "--bind", "127.0.0.1", *arguments], env=viewer_environment(), **options)


def viewer_environment() -> dict[str, str]:
    """Build the viewer's environment, with `ffmpeg` on PATH: imageio-ffmpeg's if no other is installed."""
    environment = dict(os.environ)
    environment.setdefault("RUST_LOG", "warn")
    if shutil.which("ffmpeg") is None:
        environment["PATH"] = os.pathsep.join([environment.get("PATH", ""), str(_ffmpeg_folder())])
    return environment


def _ffmpeg_folder() -> Path:
    """Make a folder with a link named ffmpeg to imageio-ffmpeg's program (such as ffmpeg-linux-x86_64-v7.0.2)."""
    import imageio_ffmpeg

    try:
        program = Path(imageio_ffmpeg.get_ffmpeg_exe())
    except RuntimeError as error:
        raise MissingDependencyError("Playing H.264", "ffmpeg", "pip install imageio-ffmpeg, or ffmpeg") from error
    folder = cache_folder("bin", program.name)
    link = folder / "ffmpeg"
    if not link.is_file():
        link.unlink(missing_ok=True)
        with suppress(FileExistsError):  # another process was faster
            link.symlink_to(program)
    return folder


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def need_screen() -> None:
    """Raise ConfigError unless a window can be opened."""
    if not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise ConfigError(
            "No screen is available for a window: use --screenshot x.png, --web for a browser, or, unless it is an "
            ".rrd file already, --save x.rrd."
        )


def show(recordings: Sequence[Path]) -> None:
    """Open a window with .rrd files and wait until it is closed.

    Raises:
        ConfigError: No screen is available.
        RecordingError: The viewer failed.
    """
    need_screen()
    code = _start_viewer("--port", "auto", "--hide-welcome-screen", *map(str, recordings)).wait()
    if code:
        raise RecordingError(f"Rerun's viewer ended with exit code {code}.")


class HeadlessViewer:
    """A viewer without a screen that shows an .rrd file, from `headless_viewer`.

    Attributes:
        client: Rerun's client of the viewer.
    """

    def __init__(self, client: ViewerClient, process: subprocess.Popen[Any]) -> None:
        self.client = client
        self._process = process

    @property
    def end(self) -> float:
        """Return seconds of the last row of the recording; 0 if it lacks that timeline."""
        first = self.client.get_state().recordings[0]
        return max((line.end / 1e9 for line in first.timelines if line.name == SECONDS), default=0.0)

    def seek(self, seconds: float) -> None:
        """Pause at a time of the episode, and wait until the image has settled (videos are decoded)."""
        for recording in self.client.get_state().recordings:
            self.client.set_time(timeline=SECONDS, duration=seconds, play_state="paused", recording=recording.store_id)
        before, same, deadline = b"", 0, time.monotonic() + _SETTLE_SECONDS
        while same < 3 and time.monotonic() < deadline:
            time.sleep(0.4)
            now = self._image()
            before, same = now, same + 1 if now == before else 0

    def _image(self, *view: Any) -> bytes:
        """Take a PNG of the window or of one view; retries, since the client's timeout is too short when busy."""
        deadline = time.monotonic() + _START_SECONDS
        while True:
            try:
                return bytes(self.client.take_screenshot(*view))
            except TimeoutError as error:
                if self._process.poll() is not None:
                    raise
                if time.monotonic() > deadline:
                    raise RecordingError(
                        f"Rerun's viewer has not drawn an image within {_START_SECONDS:.0f} s: is the machine busy?"
                    ) from error

    def save_image(self, target: Path) -> None:
        """Write the whole window as PNG. Raises OSError if it cannot be written."""
        target.write_bytes(self._image())

    def view_image(self, name: str) -> bytes:
        """Take one view as PNG; KeyError if the view does not exist."""
        for view in self.client.get_state().views:
            if view.name == name:
                return self._image(view.view_id)
        raise KeyError(name)

    def reports(self) -> list[tuple[str, Any]]:
        """List every warning and error of a view: (its name, Rerun's report)."""
        return [(view.name, report) for view in self.client.get_state().views for report in view.reports]


@contextmanager
def headless_viewer(recording: Path, *, width: int = 1600, height: int = 950) -> Iterator[HeadlessViewer]:
    """Start a viewer of an .rrd file, with a window of this size in pixels, and end it with the block.

    Raises:
        RecordingError: The graphics driver is missing, the viewer does not start or ends unexpectedly, or it cannot
            load the file.
    """
    port = _free_port()
    with tempfile.TemporaryFile(mode="w+", errors="replace") as said:  # not a pipe, which would fill up unread
        process = _start_viewer(
            "--headless", "--port", str(port), "--window-size", f"{width}x{height}", "--hide-welcome-screen",
            str(recording), stdout=subprocess.DEVNULL, stderr=said,
        )  # fmt: skip
        try:
            yield HeadlessViewer(_connect(port, process, recording), process)
        except (OSError, RuntimeError, ValueError) as error:
            # A panicking viewer disconnects before it has printed the reason.
            with suppress(subprocess.TimeoutExpired):
                process.wait(_END_SECONDS)
                said.seek(0)
                reason = " ".join(said.read().rpartition("panicked at")[2].split())
                raise RecordingError(
                    "Rerun's viewer ended by itself; without a graphics card it needs a Vulkan driver (apt-get install "
                    f"mesa-vulkan-drivers): {reason[:200]}"
                ) from error
            raise
        finally:
            _end_process(process)


def _connect(port: int, process: subprocess.Popen[Any], recording: Path) -> ViewerClient:
    for _ in _tries(0.2):
        if process.poll() is not None:
            raise ConnectionError
        with suppress(OSError, RuntimeError, ValueError):  # TimeoutError is an OSError
            client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
            state = client.get_state()
            if not state.loading and any(loaded.timelines for loaded in state.recordings):
                return client
    raise RecordingError(f"Rerun's viewer has not loaded the file within {_START_SECONDS:.0f} s: {recording}")


def _tries(pause: float) -> Iterator[None]:
    """Yield repeatedly, with a pause in seconds in between, until the viewer's start has timed out."""
    deadline = time.monotonic() + _START_SECONDS
    while time.monotonic() < deadline:
        yield
        time.sleep(pause)


def moment(seconds: float | None, end: float) -> float:
    """Choose a time of an episode that lasts until `end`, seconds; by default its middle.

    Raises:
        ConfigError: It is outside the episode.
    """
    if seconds is None:
        return end / 2
    if not 0.0 <= seconds <= end + 1e-9:
        raise ConfigError(f"--at {seconds:g} is out of range: choose 0 to {end:.3f} s, the episode's last frame.")
    return seconds


def screenshot(recording: Path, target: Path, *, seconds: float | None, width: int, height: int) -> None:
    """Save an image of the viewer with an .rrd file at a time of it, by default its middle.

    Raises:
        ConfigError: The time is outside it.
        RecordingError: The viewer cannot work on this machine, or a view reports an error.
        OSError: The image cannot be written.
    """
    with headless_viewer(recording, width=width, height=height) as viewer:
        viewer.seek(moment(seconds, viewer.end))
        for view, report in viewer.reports():
            if report.severity == "error":
                raise RecordingError(f"The view {view!r} cannot be drawn: {report.summary}.")
        viewer.save_image(target)


@contextmanager
def serve_web(recordings: Sequence[Path], *, web_port: int = 0) -> Iterator[tuple[str, Callable[[], int]]]:
    """Serve Rerun's web viewer and .rrd files to this machine alone.

    Yields:
        The address for the browser, and a function that waits until the server ends and returns its exit code.

    Raises:
        RecordingError: The port is taken, or the server does not start.
    """
    data_port, web_port = _free_port(), web_port or _free_port()
    memory = max(1024, 3 * sum(recording.stat().st_size for recording in recordings) // 2**20)
    process = _start_viewer(
        "--serve-web", "--port", str(data_port), "--web-viewer-port", str(web_port), "--server-memory-limit",
        f"{memory}MiB", *map(str, recordings), stdout=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        page = f"http://127.0.0.1:{web_port}"
        _wait_for_page(page, process)
        yield f"{page}/?url={quote(f'rerun+http://127.0.0.1:{data_port}/proxy', safe='')}", process.wait
    finally:
        _end_process(process)


def _wait_for_page(page: str, process: subprocess.Popen[Any]) -> None:
    for _ in _tries(0.1):
        if process.poll() is not None:
            break
        with suppress(OSError), urlopen(page, timeout=5):
            return
    raise RecordingError(f"Rerun's web server did not come up at {page}: is the port taken?")


def _end_process(process: subprocess.Popen[Any]) -> None:
    """Ask a process to end, and kill it if it does not within some seconds."""
    if process.poll() is None:
        process.terminate()
        try:
            process.wait(_END_SECONDS)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()

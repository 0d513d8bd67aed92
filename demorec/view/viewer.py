"""Rerun's viewer, with the ffmpeg that it needs for H.264: in a window or in the browser."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from urllib.parse import quote
from urllib.request import urlopen

from demorec.core.errors import ConfigError, MissingDependencyError, RecordingError
from demorec.core.files import cache_folder
from demorec.core.processes import start_program

_START_SECONDS = 60.0
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
        raise ConfigError("No screen is available for a window: use --web for a browser, or --save x.rrd.")


def show(recordings: Sequence[Path]) -> None:
    """Open a window with .rrd files and wait until it is closed.

    Raises:
        RecordingError: The viewer failed.
    """
    code = _start_viewer("--port", "auto", "--hide-welcome-screen", *map(str, recordings)).wait()
    if code:
        raise RecordingError(f"Rerun's viewer ended with exit code {code}.")


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
    deadline = time.monotonic() + _START_SECONDS
    while process.poll() is None and time.monotonic() < deadline:
        with suppress(OSError), urlopen(page, timeout=5):
            return
        time.sleep(0.1)
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

"""External programs of playback: Rerun's viewer, and the ffmpeg that it needs for H.264."""

from __future__ import annotations

import os
import shutil
import socket
from pathlib import Path

from demorec.core.errors import MissingDependencyError
from demorec.core.files import cache_folder


def viewer_program() -> str:
    """Find the viewer that came with rerun-sdk, so that its version matches the recordings."""
    import rerun_cli

    program = Path(rerun_cli.__file__).with_name("rerun")
    if program.is_file():
        return str(program)
    raise MissingDependencyError("Showing recordings", "rerun-sdk", "pip install 'rerun-sdk>=0.41,<0.42'")


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
        fresh = folder / f"{link.name}.{os.getpid()}"
        try:
            fresh.symlink_to(program)
        except OSError:
            shutil.copy2(program, fresh)
        fresh.replace(link)
    return folder


def free_port() -> int:
    """Find a free TCP port on this machine."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def has_display() -> bool:
    """Check whether a window can be opened."""
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))

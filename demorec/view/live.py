"""Episodes shown during a run: finished recordings are handed to a low-priority process, which sends them.

The generator never waits: handing over a file is one line into a pipe. `python -m demorec.view.live URL` is that
process; it reads paths from its standard input.
"""

from __future__ import annotations

import os
import queue
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

from demorec.core.errors import ConfigError, DemorecError
from demorec.core.files import Closing
from demorec.core.text import printable
from demorec.view.programs import free_port, has_display, viewer_environment, viewer_program

_NICENESS = 15
_END_SECONDS = 60.0


class LiveViewer(Closing):
    """Context manager over a window that finished episodes are added to; the window stays open afterwards.

    Args:
        url: Address of a running viewer ("rerun+http://127.0.0.1:9876/proxy"); None opens a window.

    Raises:
        ConfigError: No screen is available for a window.
    """

    def __init__(self, url: str | None = None) -> None:
        if url is None:
            if not has_display():
                raise ConfigError("--view needs a screen for its window: leave it out, then use demorec view --web.")
            port = free_port()
            url = f"rerun+http://127.0.0.1:{port}/proxy"
            command = [viewer_program(), "--port", str(port), "--bind", "127.0.0.1", "--expect-data-soon"]
            subprocess.Popen(
                command,
                env=viewer_environment(),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C must stop the run, not the window
            )
        self._sender = subprocess.Popen(
            [sys.executable, "-m", "demorec.view.live", url],
            stdin=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        self._paths: queue.SimpleQueue[Path | None] = queue.SimpleQueue()
        self._feeder = threading.Thread(target=self._feed, daemon=True)
        self._feeder.start()

    def add(self, recording: Path) -> None:
        """Queue a finished recording for display; returns immediately."""
        self._paths.put(recording)

    def close(self) -> None:
        """Wait up to a minute until everything added is in the viewer; safe to call twice."""
        self._paths.put(None)
        self._feeder.join(_END_SECONDS)
        try:
            self._sender.wait(_END_SECONDS)
        except subprocess.TimeoutExpired:
            self._sender.kill()
            self._sender.wait()

    def _feed(self) -> None:
        pipe: Any = self._sender.stdin
        try:
            while (path := self._paths.get()) is not None:
                pipe.write(f"{path.resolve()}\n")
                pipe.flush()
            pipe.close()
        except OSError:  # the sender has ended; the run continues without it
            return


def send(recording: Path, url: str, laid_out: set[str]) -> None:
    """Send one recording to a running viewer; also the layout, unless its application is in `laid_out`, to which it is
    added.

    Raises:
        DemorecError: The recording cannot be read.
    """
    from demorec.view.layout import episode_layout
    from demorec.view.scene import application_id, log_episode, new_recording
    from demorec.view.sources import find_episodes

    (source,) = find_episodes([recording])
    with source.open() as episode:
        stream = new_recording(episode)
        application = application_id(episode)
        layout = None if application in laid_out else episode_layout(episode)
        laid_out.add(application)
        stream.connect_grpc(url, default_blueprint=layout)
        log_episode(stream, episode)
        stream.flush(timeout_sec=_END_SECONDS)
        stream.disconnect()


def _main() -> None:
    os.nice(_NICENESS)
    url, laid_out = sys.argv[1], set[str]()
    for line in sys.stdin:
        try:
            send(Path(line.rstrip("\n")), url, laid_out)
        except DemorecError as error:
            sys.stderr.write(printable(f"--view: {error}") + "\n")


if __name__ == "__main__":
    _main()

"""Episodes to .rrd files, with the layout inside."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import rerun as rr

from demorec.core.errors import RecordingError, write_error
from demorec.view.layout import comparison_layout, episode_layout
from demorec.view.scene import log_comparison, log_episode, new_comparison, new_recording
from demorec.view.sources import PlaybackSource


def save(source: PlaybackSource, target: Path, *, is_alone: bool = True) -> None:
    """Write an episode to an .rrd file; one that is alone needs no list of episodes.

    Raises:
        DemorecError: The episode cannot be read.
        OSError: The file cannot be written.
    """
    with source.open() as episode:
        recording = new_recording(episode)
        with _saving(recording, target, episode_layout(episode, is_alone=is_alone)):
            log_episode(recording, episode)


def numbered(target: Path, count: int) -> list[Path]:
    """The names of `count` files: the target itself for one, NAME-0000.rrd and so on for several.

    Rerun's viewer shows one recording of a file (it takes the last), so several episodes are several files.
    """
    if count == 1:
        return [target]
    return [target.with_name(f"{target.stem}-{index:04d}{target.suffix}") for index in range(count)]


def save_each(sources: Sequence[PlaybackSource], folder: Path) -> list[Path]:
    """Write each episode to an .rrd file of its own.

    Raises:
        DemorecError: An episode cannot be read, or a file cannot be written.
    """
    files = [folder / f"{index:06d}.rrd" for index in range(len(sources))]
    for source, file in zip(sources, files, strict=True):
        try:
            save(source, file, is_alone=len(sources) == 1)
        except OSError as error:
            raise write_error("The file", error, file, RecordingError) from error
    return files


def save_comparison(a: PlaybackSource, b: PlaybackSource, target: Path) -> None:
    """Write two episodes over each other to one .rrd file; raises as `save`, ConfigError if they cannot be compared."""
    with a.open() as first, b.open() as second:
        recording = new_comparison(first, second)
        with _saving(recording, target, comparison_layout(first, second)):
            log_comparison(recording, first, second)


@contextmanager
def _saving(recording: rr.RecordingStream, target: Path, layout: rr.blueprint.Blueprint) -> Iterator[None]:
    """Write what is logged in the block, with its layout; OSError when that is not possible.

    An episode is gathered in memory and written from here: Rerun's own thread for files keeps it to its log when the
    disk is full, or has the program wait for ever.
    """
    stream = recording.binary_stream()
    recording.send_blueprint(layout, make_active=False, make_default=True)
    try:
        yield
    finally:
        data = stream.read()  # in any case: Rerun warns on the terminal of what nobody has read
        recording.disconnect()
    assert data is not None  # there is a layout, at least
    target.write_bytes(data)

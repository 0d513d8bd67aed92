"""Export of episodes to .rrd files, with the layout inside."""

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
    """Write an episode to an .rrd file; a single one needs no list of episodes.

    Raises:
        DemorecError: The episode cannot be read.
        OSError: The file cannot be written.
    """
    with source.open() as episode:
        recording = new_recording(episode)
        with _saving(recording, target, episode_layout(episode, is_alone=is_alone)):
            log_episode(recording, episode)


def numbered(target: Path, count: int) -> list[Path]:
    """Name `count` files: the target itself for one, NAME-0000.rrd and so on for several.

    Rerun's viewer shows only the last recording of a file, so several episodes are several files.
    """
    if count == 1:
        return [target]
    return [target.with_name(f"{target.stem}-{index:04d}{target.suffix}") for index in range(count)]


def save_each(sources: Sequence[PlaybackSource], folder: Path) -> list[Path]:
    """Write each episode to a separate .rrd file.

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
    """Overlay two episodes in one .rrd file; raises as `save`, ConfigError if they cannot be compared."""
    with a.open() as first, b.open() as second:
        recording = new_comparison(first, second)
        with _saving(recording, target, comparison_layout(first, second)):
            log_comparison(recording, first, second)


@contextmanager
def _saving(recording: rr.RecordingStream, target: Path, layout: rr.blueprint.Blueprint) -> Iterator[None]:
    """Write everything logged in the block, with its layout; OSError if writing fails.

    An episode is collected in memory and written here: when the disk is full, Rerun's own file thread only logs the
    error, or blocks forever.
    """
    stream = recording.binary_stream()
    recording.send_blueprint(layout, make_active=False, make_default=True)
    try:
        yield
    finally:
        data = stream.read()  # in any case: Rerun warns on the terminal about unread data
        recording.disconnect()
    assert data is not None  # at least the layout
    target.write_bytes(data)

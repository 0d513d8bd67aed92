"""Recorded images against the drawn ones, within what the coder itself does to them.

Only asked where coded bytes differ from those made again. Colours are compared in three ways: no block of 8x8 pixels
may be farther from the drawn one than twice what the coder makes of it, or of one beside it, and two levels (a torn,
painted or shifted part); the image is as sharp as the coder leaves it (a blurred one is a little off along all
edges); and its mean colour is the same to three levels. Images that were decoded and coded a second time, with H.264
at crf 23 and 35, AV1 and JPEG, at 96 and 224 pixels, reach 0.95 of the first limit and a sharpness of 0.89 to 1.12 of
the coder's own. Depth and labels are coded without loss, so every pixel counts.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import RecordingError
from demorec.core.geometry import Array
from demorec.mcap import Recording
from demorec.mcap.lossless import decode_depth, decode_labels
from demorec.mcap.messages import message_fields
from demorec.mcap.video import Rgb, VideoPacket, VideoSettings, decode, is_keyframe
from demorec.render.painter import Painter
from demorec.replay.deep.contents import Contents, RemakeDifference
from demorec.sim.recorded_states import RecordedStates

_BLOCK = 8
"""Pixels a side: those of a transform in H.264."""
_BLOCK_RATIO = 2.0
"""Maximum difference of a block, as a multiple of the coder's own."""
_BLOCK_LEVELS = 2.0
"""Levels that a block may differ beyond that."""
_MIN_SHARPNESS = 0.84
_MAX_SHARPNESS = 1.2
"""Sharpness of an image, relative to the coder's own."""
_MAX_MEAN_LEVELS = 3.0
"""Maximum difference of an image's mean colour."""


def image_differences(
    recorded: Contents,
    again: Contents,
    remade: Recording,
    painter: Painter,
    cameras: Mapping[str, str],
    differing: Mapping[str, Sequence[int]],
) -> Iterator[RemakeDifference]:
    """One or two differences for each stream whose coded images differ: what shows something else, and what does not.

    Args:
        recorded, again: The two files.
        remade: The one made again, open.
        painter: Draws what it shows.
        cameras: Topic -> camera, of streams of coded images.
        differing: Topic -> frames whose coded images differ.
    """
    for topic, frames in differing.items():
        settings = remade.video_settings(cameras[topic])
        images = _coded(recorded, topic), _coded(again, topic)
        if topic.rpartition("/")[2] in ("depth", "segmentation"):
            found = dict(_lossless(topic, *images, (settings.height, settings.width)))
        else:
            found = dict(_colours(settings, *images, _drawn(remade, painter, cameras[topic])))
        if found:
            yield RemakeDifference(
                stream=topic,
                field="image",
                frames=tuple(found),
                recorded=next(iter(found.values())),
                again="",
            )
        coding = tuple(frame for frame in frames if frame not in found)
        if coding:
            yield RemakeDifference(
                stream=topic,
                field="data",
                frames=coding,
                recorded="coded otherwise, but the same image within the coder's own error",
                again="",
                is_coding=True,
            )


def _coded(contents: Contents, topic: str) -> list[bytes]:
    """The coded images of a topic in order; empty bytes for what is no message of an image."""
    images = []
    for _, found in sorted(contents.messages[topic].items()):
        try:
            data = message_fields(contents.schemas[topic], found[0]).get("data")
        except ValueError:
            data = None
        images.append(data if isinstance(data, bytes) else b"")
    return images


def _drawn(remade: Recording, painter: Painter, camera: str) -> Iterator[Rgb]:
    states = RecordedStates(remade.info.simulated.robot, remade.info.simulated.scene, remade.trajectory())
    painter.setup(states)
    for frame in range(remade.num_frames):
        states.frame = frame
        yield painter.images()[camera].color


def _lossless(
    topic: str, recorded: Sequence[bytes], again: Sequence[bytes], size: tuple[int, int]
) -> Iterator[tuple[int, str]]:
    """(frame, what is off) of every depth or segmentation image that is not the same."""
    is_depth = topic.endswith("/depth")
    read: Any = decode_depth if is_depth else decode_labels
    for frame, (data, expected) in enumerate(zip(recorded, again, strict=False)):
        if data == expected:
            continue
        try:
            a: NDArray[Any] = read(data, size)
        except (ValueError, OSError, SyntaxError) as error:
            yield frame, f"cannot be decoded ({error})"
            continue
        differs = a != (b := read(expected, size))
        if differs.any():
            most = f", at most {np.abs(a - b).max():.3f} m" if is_depth else ""
            yield frame, f"shows something else in {int(differs.sum())} of {differs.size} pixels{most}"


def _colours(
    settings: VideoSettings, recorded: Sequence[bytes], again: Sequence[bytes], drawn: Iterator[Rgb]
) -> Iterator[tuple[int, str]]:
    """(frame, what is off) of every colour image that is farther from the drawn one than the coder's own."""
    images = _decoded(settings, recorded)
    for frame, (own, true) in enumerate(zip(_decoded(settings, again), drawn, strict=True)):
        try:
            image = next(images, None)
        except RecordingError as error:
            yield frame, f"cannot be decoded ({error})"
            return  # a decoder that has lost the thread
        if image is None:
            return  # missing images are reported as missing messages
        words = _beyond_coding(image, own, true)
        if words:
            yield frame, words


def _beyond_coding(image: Rgb, own: Rgb, true: Rgb) -> str:
    """In what an image is farther from the true one than the coder's own, in words; "" in nothing."""
    off, coders = _blocks(image, true), _blocks(own, true)
    allowed = _BLOCK_RATIO * _around(coders) + _BLOCK_LEVELS
    beyond = off > allowed
    if beyond.any():
        row, column = np.unravel_index(int(np.argmax(off - allowed)), off.shape)
        place = f"({column * _BLOCK}, {row * _BLOCK})"
        levels = f"{off[row, column]:.0f} levels where {allowed[row, column]:.0f} are allowed"
        return f"shows something else in {int(beyond.sum())} of {beyond.size} blocks, at {place} by {levels}"
    sharpness = (_edges(image) + 0.1) / (_edges(own) + 0.1)  # 0.1: of an image without edges nothing is asked
    if not _MIN_SHARPNESS <= sharpness <= _MAX_SHARPNESS:
        return f"has {sharpness:.0%} of the sharpness that the coder leaves"
    mean = np.abs(image.mean(axis=(0, 1)) - own.mean(axis=(0, 1))).max()
    return f"has another mean colour, by {mean:.1f} levels" if mean > _MAX_MEAN_LEVELS else ""


def _decoded(settings: VideoSettings, coded: Sequence[bytes]) -> Iterator[Rgb]:
    packets = (
        VideoPacket(frame_index=frame, time_ns=0, data=data, is_keyframe=is_keyframe(settings.codec, data))
        for frame, data in enumerate(coded)
    )
    return decode(settings, packets)


def _blocks(a: Rgb, b: Rgb) -> Array:
    """(rows, columns) mean absolute difference of two images in blocks, levels; an incomplete one counts as well."""
    off = np.abs(a.astype(np.int16) - b).mean(axis=2)
    starts = [np.arange(0, length, _BLOCK) for length in off.shape]
    sums = np.add.reduceat(np.add.reduceat(off, starts[0], axis=0), starts[1], axis=1)
    sizes = [np.diff([*start, length]) for start, length in zip(starts, off.shape, strict=True)]
    return np.asarray(sums / np.outer(*sizes))


def _around(blocks: Array) -> Array:
    """The largest of each block and its eight neighbours."""
    rows, columns = blocks.shape
    padded = np.pad(blocks, 1, mode="edge")
    shifted = [padded[i : i + rows, j : j + columns] for i in range(3) for j in range(3)]
    return np.asarray(np.max(shifted, axis=0))


def _edges(image: Rgb) -> float:
    """Mean size of the second differences of an image's brightness, levels."""
    grey = image.astype(np.float64).mean(axis=2)
    inner = 4 * grey[1:-1, 1:-1] - grey[:-2, 1:-1] - grey[2:, 1:-1] - grey[1:-1, :-2] - grey[1:-1, 2:]
    return float(np.abs(inner).mean())

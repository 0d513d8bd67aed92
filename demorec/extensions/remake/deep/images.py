"""Decode encoded images that differ, and measure the number of different pixels and the largest difference."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import RecordingError, describe_error
from demorec.extensions.remake.deep.contents import Contents, RemakeDifference
from demorec.mcap import Recording
from demorec.mcap.lossless import decode_depth, decode_labels
from demorec.mcap.messages import message_fields
from demorec.mcap.video import VideoPacket, VideoSettings, decode, is_keyframe


def image_differences(
    recorded: Contents,
    again: Contents,
    remade: Recording,
    cameras: Mapping[str, str],
    differing: Mapping[str, Sequence[int]],
) -> Iterator[RemakeDifference]:
    """Yield one difference per stream with encoded images that differ.

    Args:
        recorded, again: The two files.
        remade: The remake, open.
        cameras: Topic -> camera, for streams of encoded images.
        differing: Topic -> frames with different encoded images.
    """
    for topic, frames in differing.items():
        settings = remade.video_settings(cameras[topic])
        pairs = zip(_decoded(recorded, topic, settings), _decoded(again, topic, settings), strict=False)
        words = "the image cannot be decoded"
        try:
            image, made = next(pair for frame, pair in enumerate(pairs) if frame == frames[0])
            words = _in_words(image, made)
        except StopIteration:
            pass
        except (RecordingError, ValueError, OSError, SyntaxError) as error:
            words += f" ({describe_error(error)})"
        yield RemakeDifference(stream=topic, field="image", frames=tuple(frames), recorded=words, again="")


def _in_words(image: NDArray[Any], made: NDArray[Any]) -> str:
    differs = image != made
    if not differs.any():
        return "the image is encoded differently, and shows the same"
    pixels = differs.any(axis=2) if differs.ndim == 3 else differs
    words = f"the image differs in {int(pixels.sum())} of {pixels.size} pixels"
    if image.dtype == np.uint8:
        return f"{words}, by up to {np.abs(image.astype(np.int16) - made).max()} of 255 levels"
    return f"{words}, by up to {np.abs(image - made).max():.3f} m" if image.dtype == np.float32 else words


def _decoded(contents: Contents, topic: str, settings: VideoSettings) -> Iterator[NDArray[Any]]:
    """Decode the images of a topic in order: colour (H, W, 3) uint8, depth (H, W) float32, or labels int32."""
    encoded = (_encoded(contents, topic, found[0]) for _, found in sorted(contents.messages[topic].items()))
    lossless: Any = {"depth": decode_depth, "segmentation": decode_labels}.get(topic.rpartition("/")[2])
    if lossless is not None:
        return (lossless(data, (settings.height, settings.width)) for data in encoded)
    packets = (
        VideoPacket(frame_index=frame, time_ns=0, data=data, is_keyframe=is_keyframe(settings.codec, data))
        for frame, data in enumerate(encoded)
    )
    return decode(settings, packets)


def _encoded(contents: Contents, topic: str, message: bytes) -> bytes:
    """The encoded image of a message; no bytes if it is not a message of an image."""
    try:
        data = message_fields(contents.schemas[topic], message).get("data")
    except ValueError:
        data = None
    return data if isinstance(data, bytes) else b""

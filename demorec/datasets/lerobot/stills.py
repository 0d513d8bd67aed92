"""Single pictures out of a dataset's videos, whoever wrote them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import ExportError, in_words
from demorec.datasets.lerobot.files import check_video
from demorec.datasets.lerobot.layout import VIDEO_PATH, DatasetInfo
from demorec.datasets.lerobot.reader import EpisodePlace


def pictures_at(
    root: Path, info: DatasetInfo, key: str, place: EpisodePlace, frames: Sequence[int]
) -> Iterator[NDArray[np.uint8]]:
    """(H, W, 3) uint8 RGB of some frames of an episode.

    Args:
        root: The dataset's folder.
        info: Of it.
        key: Name of the camera feature.
        place: Of the episode.
        frames: Numbers from 0 within the episode.

    Raises:
        ExportError: The video cannot be decoded, or ends before a frame.
    """
    position, first = place.videos[key]
    path = root / position.path(info.video_path or VIDEO_PATH, key)
    check_video(path)
    height, width = info.features[key].shape[:2]
    try:
        with av.open(str(path), format="mp4") as container:
            stream = container.streams.video[0]
            stream.thread_type = "NONE"  # starting threads costs more than a few pictures
            # A few bytes can announce pictures of gigabytes; coded pictures are whole blocks of at most 128 pixels.
            stream.codec_context.options = {"max_pixels": str((height + 128) * (width + 128))}
            for frame in frames:
                yield _picture(container, stream, (first + frame) / info.fps, 0.5 / info.fps)
    except (OSError, EOFError, IndexError, av.FFmpegError) as error:
        raise ExportError(f"The video cannot be decoded ({in_words(error)}): {path}") from error


def _picture(
    container: av.container.InputContainer, stream: av.video.stream.VideoStream, time: float, tolerance: float
) -> NDArray[np.uint8]:
    """The picture that is shown at `time`, seconds."""
    assert stream.time_base is not None
    container.seek(round(time / stream.time_base), stream=stream)
    for frame in container.decode(stream):
        if frame.time is not None and frame.time > time - tolerance:
            return np.asarray(frame.to_ndarray(format="rgb24"), dtype=np.uint8)
    raise EOFError(f"no picture at {time:.2f} s")

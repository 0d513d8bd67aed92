"""Encoded images of some frames of an episode, cut out of a dataset's mp4 files byte for byte."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import ExportError
from demorec.datasets.lerobot.mp4 import EncodedVideo, Stored
from demorec.datasets.lerobot.mp4_index import mp4_index
from demorec.datasets.lerobot.reader import EpisodePlace
from demorec.datasets.lerobot.videos import access_units, codec_of, opened_video

_MP4_NAMES = {"h265": "hevc"}
_MOST_REORDERED = 32
"""Images by which one is stored before it is shown; codecs allow 16."""
_MOST_FILES = 16
"""Of which the tables are kept: a file of 15 minutes has one MB of them."""
OpenVideo = Callable[[Path, float], "VideoFile"]


def video_files() -> OpenVideo:
    """What opens the mp4 files of any number of datasets, with their rate, and keeps some for episodes in any order."""
    return lru_cache(maxsize=_MOST_FILES)(VideoFile)


class VideoFile:
    """What an mp4 file contains; ExportError when it cannot be read.

    Attributes:
        path: Of it.
        fps: Frames a second.
        offsets, sizes, is_keyframe: (N,) of its images.
        frames: (N,) int64, number of the frame at which each is shown.
        order: (N,) by which these rise.
        keys: (K,) numbers of the keyframes.
        codec, size, pixels: As libav describes it; size is (width, height).
    """

    def __init__(self, path: Path, fps: float) -> None:
        self.path, self.fps = path, fps
        self.offsets, self.sizes, self.is_keyframe, times = mp4_index(path)
        self.frames: NDArray[np.int64] = np.rint(times * fps).astype(np.int64)
        self.order = np.argsort(self.frames, kind="stable")
        self.keys = np.flatnonzero(self.is_keyframe)
        with opened_video(path) as (_, stream):
            context = stream.codec_context
            self.codec = codec_of(stream)
            self.size, self.pixels = (context.width, context.height), context.pix_fmt
            extra = context.extradata or b""
            length_size = extra[4] if self.codec == "h264" else extra[21] if len(extra) > 21 else 3
            if self.codec != "av1" and (length_size & 3) != 3:
                raise ExportError(f"The video has lengths of less than four bytes, which are not copied: {path}")
        self._head = b""

    def _first_image(self, begin: int, size: int) -> bytes:
        """A first image as it was encoded: behind the parameter sets, which of H.264 and HEVC are those of the file."""
        if self.codec != "av1" and self._head:
            return self._head
        sample = Stored(path=self.path, spans=((begin, size),)).read()
        if self.codec == "av1":
            return b"\x12\x00" + sample
        if not self._head:
            with opened_video(self.path) as (_, stream):
                self._head = access_units(stream, self.codec)(av.Packet(sample))
        return self._head

    def stream_info(self) -> dict[str, Any]:
        """What a dataset states about how its images are encoded."""
        return {
            "video.height": self.size[1],
            "video.width": self.size[0],
            "video.codec": _MP4_NAMES.get(self.codec, self.codec),
            "video.pix_fmt": self.pixels,
            "video.fps": int(self.fps),
            "video.channels": 3,
            "has_audio": False,
            "is_depth_map": False,
        }

    def cut(self, place: EpisodePlace, key: str, first: int, last: int) -> EncodedVideo:
        """The images of an episode's frames from `first` to before `last`, with all from which these are decoded.

        Raises:
            ExportError: They are not there, or cannot be taken out without encoding them again.
        """
        begin, end = place.videos[key][1] + first, place.videos[key][1] + last
        wanted = self.order[slice(*np.searchsorted(self.frames, (begin, end), sorter=self.order))]
        if len(wanted) != last - first:
            count = f"{len(wanted)} images for {last - first} frames of {key}"
            raise ExportError(f"Episode {place.episode_index} has {count}: {self.path}")
        keys = self.keys[: np.searchsorted(self.keys, wanted.min(), side="right")]
        keys = keys[self.frames[keys] <= begin]
        if not len(keys):
            raise ExportError(f"Episode {place.episode_index} does not begin behind a keyframe of {key}: {self.path}")
        keyframe = int(self.frames[keys[-1]])
        part = _without_gaps(self.frames, int(keys[-1]), int(wanted.max()) + 1)
        places = self.frames[part] - keyframe
        if not np.array_equal(np.sort(places), np.arange(len(places))):
            raise ExportError(f"Two images of {key} are shown at one time, or none at some: {self.path}")
        shifts = places - np.arange(len(places))
        sizes = self.sizes[part]
        spans = _spans(self.offsets[part], sizes)
        return EncodedVideo(
            codec=_MP4_NAMES.get(self.codec, self.codec),
            width=self.size[0],
            height=self.size[1],
            first=self._first_image(spans[0][0], int(sizes[0])),
            samples=Stored(path=self.path, spans=spans),
            sizes=sizes,
            is_keyframe=self.is_keyframe[part],
            lead=begin - keyframe,
            tail=len(places) - (end - keyframe),
            shifts=shifts if shifts.any() else None,
        )


def _without_gaps(frames: NDArray[np.int64], begin: int, end: int) -> NDArray[np.intp]:
    """The images from one on, in the order in which they are stored, with those that later ones are decoded from.

    Images may be shown in another order than they are stored in. Those that are stored behind the keyframe and shown
    before it need images that are not taken. Behind the last wanted one follow as many as it takes until at every
    moment one is shown.
    """
    last = min(end + _MOST_REORDERED, len(frames))
    while True:
        part: NDArray[np.intp] = begin + np.flatnonzero(frames[begin:end] >= frames[begin])
        if len(part) > int(frames[part].max() - frames[begin]) or end >= last:
            return part
        end += 1


def _spans(offsets: NDArray[np.int64], sizes: NDArray[np.int64]) -> tuple[tuple[int, int], ...]:
    """(begin, bytes) of the parts of a file in which images lie one behind the other."""
    ends = offsets + sizes
    begins = np.flatnonzero(np.append(True, offsets[1:] != ends[:-1]))
    lasts = np.append(begins[1:], len(offsets)) - 1
    return tuple(zip(offsets[begins].tolist(), (ends[lasts] - offsets[begins]).tolist(), strict=True))

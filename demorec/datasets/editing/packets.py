"""Encoded images of some frames of an episode, cut out of a dataset's mp4 files byte for byte."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import ExportError
from demorec.datasets.lerobot.layout import VIDEO_PATH, DatasetInfo
from demorec.datasets.lerobot.mp4 import EncodedVideo, Stored
from demorec.datasets.lerobot.mp4_index import mp4_index
from demorec.datasets.lerobot.reader import EpisodePlace
from demorec.datasets.lerobot.videos import access_units, codec_of, opened_video

_MP4_NAMES = {"h265": "hevc"}
_MOST_REORDERED = 32
"""Images by which one is stored before it is shown; codecs allow 16."""
_MOST_FILES = 16
"""Of which the tables are kept: a file of 15 minutes has one MB of them."""


class _VideoFile:
    """One mp4 file, opened.

    Attributes:
        path: Of it.
        offsets, sizes, is_keyframe: (N,) of its images.
        frames: (N,) int64, number of the frame at which each is shown.
        order: (N,) by which these rise.
        keys: (K,) numbers of the keyframes.
        codec, size, pixels: As libav describes it; size is (width, height).
    """

    def __init__(self, path: Path, fps: int) -> None:
        self.path = path
        index = mp4_index(path)
        self.offsets, self.sizes, self.is_keyframe = index.offsets, index.sizes, index.is_keyframe
        self.frames: NDArray[np.int64] = np.rint(index.times * fps).astype(np.int64)
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

    def shown(self, begin: int, end: int) -> NDArray[np.intp]:
        """The images of the frames from one to before another."""
        first, last = np.searchsorted(self.frames, (begin, end), sorter=self.order)
        return self.order[first:last]

    def first_image(self, begin: int, size: int) -> bytes:
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


class VideoFiles:
    """The mp4 files of any number of datasets; what some of them contain is kept, for episodes in any order."""

    def __init__(self) -> None:
        self._files: dict[Path, _VideoFile] = {}

    def open(self, path: Path, fps: int) -> _VideoFile:
        """One of them; ExportError when it cannot be read."""
        file = self._files.pop(path) if path in self._files else _VideoFile(path, fps)
        self._files[path] = file
        if len(self._files) > _MOST_FILES:
            del self._files[next(iter(self._files))]
        return file


class PacketCutter:
    """The videos of one camera feature of a dataset."""

    def __init__(self, root: Path, info: DatasetInfo, key: str, files: VideoFiles) -> None:
        self._root, self._info, self._key, self._files = root, info, key, files

    def _open(self, place: EpisodePlace) -> _VideoFile:
        position, _ = place.videos[self._key]
        return self._files.open(
            self._root / position.path(self._info.video_path or VIDEO_PATH, self._key), self._info.fps
        )

    def stream_info(self, place: EpisodePlace) -> dict[str, Any]:
        """What a dataset states about how its images are encoded."""
        file = self._open(place)
        return {
            "video.height": file.size[1],
            "video.width": file.size[0],
            "video.codec": _MP4_NAMES.get(file.codec, file.codec),
            "video.pix_fmt": file.pixels,
            "video.fps": int(self._info.fps),
            "video.channels": 3,
            "has_audio": False,
            "is_depth_map": False,
        }

    def cut(self, place: EpisodePlace, first: int, last: int) -> EncodedVideo:
        """The images of the frames from `first` to before `last`, with all from which these are decoded.

        Raises:
            ExportError: They are not there, or cannot be taken out without encoding them again.
        """
        file = self._open(place)
        path, begin, end = file.path, place.videos[self._key][1] + first, place.videos[self._key][1] + last
        wanted = file.shown(begin, end)
        if len(wanted) != last - first:
            raise ExportError(
                f"Episode {place.episode_index} has {len(wanted)} images for {last - first} frames of {self._key}: "
                f"{path}"
            )
        keys = file.keys[: np.searchsorted(file.keys, wanted.min(), side="right")]
        keys = keys[file.frames[keys] <= begin]
        if not len(keys):
            raise ExportError(f"Episode {place.episode_index} does not begin behind a keyframe of {self._key}: {path}")
        part = _without_gaps(file.frames, int(keys[-1]), int(wanted.max()) + 1)
        places = file.frames[part] - file.frames[keys[-1]]
        if not np.array_equal(np.sort(places), np.arange(len(places))):
            raise ExportError(f"Two images of {self._key} are shown at one time, or none at some: {path}")
        lead, count = begin - int(file.frames[keys[-1]]), last - first
        shifts = places - np.arange(len(places))
        sizes = file.sizes[part]
        spans = _spans(file.offsets[part], sizes)
        return EncodedVideo(
            codec=_MP4_NAMES.get(file.codec, file.codec),
            width=file.size[0],
            height=file.size[1],
            first=file.first_image(spans[0][0], int(sizes[0])),
            samples=Stored(path=path, spans=spans),
            sizes=sizes,
            is_keyframe=file.is_keyframe[part],
            lead=lead,
            tail=len(places) - lead - count,
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

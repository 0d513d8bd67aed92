"""Encoded images of some frames of an episode, cut out of a dataset's mp4 files byte for byte."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import av
import numpy as np

from demorec.core.errors import ExportError
from demorec.datasets.lerobot.layout import VIDEO_PATH, DatasetInfo
from demorec.datasets.lerobot.mp4 import EncodedVideo
from demorec.datasets.lerobot.mp4_index import Mp4Index, mp4_index
from demorec.datasets.lerobot.reader import EpisodePlace
from demorec.datasets.lerobot.videos import access_units, codec_of, opened_video

_MP4_NAMES = {"h265": "hevc"}


class PacketCutter:
    """The videos of one camera feature of a dataset; the index of one file is in memory."""

    def __init__(self, root: Path, info: DatasetInfo, key: str) -> None:
        self._root, self._info, self._key = root, info, key
        self._path = Path()

    def _open(self, path: Path) -> None:
        if path == self._path:
            return
        self._index: Mp4Index = mp4_index(path)
        with opened_video(path) as (_, stream):
            context = stream.codec_context
            self._codec = codec_of(stream)
            self._size, self._pixels = (context.width, context.height), context.pix_fmt
            self._head = b""
            extra = context.extradata or b""
            length_size = extra[4] if self._codec == "h264" else extra[21] if len(extra) > 21 else 3
            if self._codec != "av1" and (length_size & 3) != 3:
                raise ExportError(f"The video has lengths of less than four bytes, which are not copied: {path}")
        self._frames = np.rint(self._index.times * self._info.fps).astype(np.int64)
        self._path = path

    def stream_info(self, place: EpisodePlace) -> dict[str, Any]:
        """What a dataset states about how its images are encoded."""
        self._open(self._file(place))
        return {
            "video.height": self._size[1],
            "video.width": self._size[0],
            "video.codec": _MP4_NAMES.get(self._codec, self._codec),
            "video.pix_fmt": self._pixels,
            "video.fps": int(self._info.fps),
            "video.channels": 3,
            "has_audio": False,
            "is_depth_map": False,
        }

    def _file(self, place: EpisodePlace) -> Path:
        position, _ = place.videos[self._key]
        return self._root / position.path(self._info.video_path or VIDEO_PATH, self._key)

    def cut(self, place: EpisodePlace, first: int, last: int) -> EncodedVideo:
        """The images of the frames from `first` to before `last`, behind those from which the first one is decoded.

        Raises:
            ExportError: They are not there, or cannot be taken out without encoding them again.
        """
        path = self._file(place)
        self._open(path)
        start = place.videos[self._key][1]
        wanted = np.flatnonzero((self._frames >= start + first) & (self._frames < start + last))
        if len(wanted) != last - first:
            raise ExportError(
                f"Episode {place.episode_index} has {len(wanted)} images for {last - first} frames of {self._key}: "
                f"{path}"
            )
        keys = np.flatnonzero(self._index.is_keyframe)
        keys = keys[keys <= wanted.min()]
        keys = keys[self._frames[keys] <= start + first]
        if not len(keys):
            raise ExportError(f"Episode {place.episode_index} does not begin behind a keyframe of {self._key}: {path}")
        part = slice(int(keys[-1]), int(wanted.max()) + 1)
        frames, lead = self._frames[part], start + first - int(self._frames[keys[-1]])
        places = frames - frames.min()
        if not np.array_equal(np.sort(places), np.arange(len(places))) or len(places) != lead + last - first:
            raise ExportError(
                f"Episode {place.episode_index} cannot be cut at frame {last} of {self._key}, since its images are not "
                f"shown in the order in which they were encoded: cut at a keyframe, or keep the end: {path}"
            )
        shifts = places - np.arange(len(places))
        samples = self._read(path, part)
        sizes = self._index.sizes[part]
        behind = int(sizes[:lead].sum())
        return EncodedVideo(
            codec=_MP4_NAMES.get(self._codec, self._codec),
            width=self._size[0],
            height=self._size[1],
            first=self._first(path, samples[: int(sizes[0])]),
            samples=samples,
            sizes=sizes,
            is_keyframe=self._index.is_keyframe[part],
            digest=hashlib.sha256(memoryview(samples)[behind:]).hexdigest(),
            lead=lead,
            shifts=shifts if shifts.any() else None,
        )

    def _read(self, path: Path, part: slice) -> bytes:
        offsets, sizes = self._index.offsets[part], self._index.sizes[part]
        with path.open("rb") as file:
            if np.array_equal(offsets[1:], (offsets + sizes)[:-1]):
                file.seek(int(offsets[0]))
                return file.read(int(sizes.sum()))
            pieces = []
            for offset, size in zip(offsets.tolist(), sizes.tolist(), strict=True):
                file.seek(offset)
                pieces.append(file.read(size))
            return b"".join(pieces)

    def _first(self, path: Path, sample: bytes) -> bytes:
        """A first image as it was encoded: behind the parameter sets, which of H.264 and HEVC are those of the file."""
        if self._codec == "av1":
            return b"\x12\x00" + sample
        if not self._head:
            with opened_video(path) as (_, stream):
                self._head = access_units(stream, self._codec)(av.Packet(sample))
        return self._head

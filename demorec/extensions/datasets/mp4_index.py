"""The index of an mp4 file: the tables in its `moov` box (ISO/IEC 14496-12)."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import ExportError, describe_error
from demorec.core.files import open_regular

_PARENTS = (b"trak", b"mdia", b"minf", b"stbl", b"edts")


def check_video(path: Path) -> None:
    """Raise ExportError unless a file is a regular one that consists of complete mp4 boxes."""
    try:
        with open_regular(path) as file:
            for _ in _boxes(file, 0, os.fstat(file.fileno()).st_size):
                pass
    except (OSError, ValueError, struct.error) as error:
        raise ExportError(f"The video cannot be opened ({describe_error(error)}): {path}") from error


def _read(file: BinaryIO, begin: int, layout: str) -> tuple[Any, ...]:
    file.seek(begin)
    return struct.unpack(layout, file.read(struct.calcsize(layout)))


def _boxes(file: BinaryIO, start: int, end: int) -> Iterator[tuple[bytes, int, int]]:
    """(type, first byte of its content, end) of the boxes in a part of a file. A box begins with its length (1: 64 bits
    follow; 0: to the end) and its type.
    """
    while start + 8 <= end:
        (length, kind), head = _read(file, start, ">I4s"), 8
        if length == 1:
            (length,), head = _read(file, start + 8, ">Q"), 16
        length = length or end - start
        if length < head or start + length > end:
            raise ValueError("a box that is cut off" if start else "not an mp4 file")
        yield kind, start + head, start + length
        start += length


def _flat(file: BinaryIO, start: int, end: int) -> dict[bytes, bytes]:
    found, waiting = {}, [(start, end)]
    for part in waiting:
        for kind, begin, stop in _boxes(file, *part):
            if kind in _PARENTS:
                waiting.append((begin, stop))
            else:
                file.seek(begin)
                found[kind] = file.read(stop - begin)
    return found


Index = tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_], NDArray[np.float64]]
"""(N,) arrays for N images in storage order: offsets in the file and lengths, bytes; whether they are keyframes;
display times, s.
"""


def mp4_index(path: Path) -> Index:
    """Read the index of the first video track. Raises ExportError for a truncated file or one that is not mp4."""
    check_video(path)
    try:
        with open_regular(path) as file:
            size = os.fstat(file.fileno()).st_size
            boxes: dict[bytes, list[int]] = {}
            for kind, *part in _boxes(file, 0, size):
                boxes.setdefault(kind, part)
            if b"moov" not in boxes:
                raise ValueError("it has no index")
            if b"moof" in boxes:
                raise ValueError("it is in fragments: ffmpeg -i FILE -c copy NEW.mp4 joins them")
            begin, end = boxes[b"moov"]
            tracks = (_flat(file, *part) for kind, *part in _boxes(file, begin, end) if kind == b"trak")
            track = next((track for track in tracks if track.get(b"hdlr", b"")[8:12] == b"vide"), None)
            if track is None:
                raise ValueError("it has no video track")
            return _index(track, size)
    except (OSError, EOFError, ValueError, KeyError, IndexError, struct.error) as error:
        raise ExportError(f"The video cannot be read ({describe_error(error)}): {path}") from error


def _index(track: Mapping[bytes, bytes], size: int) -> Index:
    (timescale,) = struct.unpack_from(">I", track[b"mdhd"], 20 if track[b"mdhd"][0] else 12)
    each, count = struct.unpack_from(">II", track[b"stsz"], 4)
    sizes = _numbers(track[b"stsz"], 12, count) if not each else np.full(count, each, dtype=np.int64)
    is_keyframe = np.ones(count, dtype=np.bool_)
    if b"stss" in track:
        is_keyframe[:] = False
        is_keyframe[_numbers(track[b"stss"], 8, _count(track[b"stss"])) - 1] = True
    steps = _repeated(track[b"stts"], count)
    ticks = np.concatenate([[0], np.cumsum(steps)[:-1]])
    if b"ctts" in track:
        ticks = ticks + _repeated(track[b"ctts"], count, signed=True)
    if b"elst" in track and _count(track[b"elst"]):
        ticks = ticks - _edited(track[b"elst"])
    offsets = _offsets(track, sizes)
    if count and (offsets.min() < 0 or (offsets + sizes).max() > size):
        raise ValueError("it is cut off")
    return offsets, sizes, is_keyframe, ticks / timescale


def _count(box: bytes) -> int:
    return int(struct.unpack_from(">I", box, 4)[0])


def _numbers(box: bytes, start: int, count: int, kind: str = ">u4") -> NDArray[np.int64]:
    return np.frombuffer(box, dtype=kind, offset=start, count=count).astype(np.int64)


def _repeated(box: bytes, count: int, *, signed: bool = False) -> NDArray[np.int64]:
    runs = _numbers(box, 8, 2 * _count(box), ">u4").reshape(-1, 2)
    values = runs[:, 1].astype(np.uint32).astype(np.int32).astype(np.int64) if signed else runs[:, 1]
    if int(runs[:, 0].sum()) != count:
        raise ValueError("its tables contradict each other")
    return np.repeat(values, runs[:, 0])


def _edited(box: bytes) -> int:
    """Start of the first edit that is not empty, ticks."""
    width, kind = (20, ">Qq") if box[0] else (12, ">Ii")
    for number in range(_count(box)):
        _, begin = struct.unpack_from(kind, box, 8 + number * width)
        if begin >= 0:
            return int(begin)
    return 0


def _offsets(track: Mapping[bytes, bytes], sizes: NDArray[np.int64]) -> NDArray[np.int64]:
    name, kind = (b"co64", ">u8") if b"co64" in track else (b"stco", ">u4")
    chunks = _numbers(track[name], 8, _count(track[name]), kind)
    runs = _numbers(track[b"stsc"], 8, 3 * _count(track[b"stsc"])).reshape(-1, 3)
    lasts = np.append(runs[1:, 0], len(chunks) + 1)
    per_chunk = np.repeat(runs[:, 1], lasts - runs[:, 0])
    if len(per_chunk) != len(chunks) or int(per_chunk.sum()) != len(sizes):
        raise ValueError("its tables contradict each other")
    before = np.concatenate([[0], np.cumsum(sizes)[:-1]])
    firsts = np.concatenate([[0], np.cumsum(per_chunk)[:-1]])
    return np.asarray(before + np.repeat(chunks - before[np.minimum(firsts, len(sizes) - 1)], per_chunk))

"""Access units (one coded picture each) of H.264, HEVC and AV1: what an mp4 file needs to know about them.

H.264 and HEVC come as Annex B (ITU-T H.264, annex B: start codes between NAL units), AV1 as open bitstream units
(AV1 specification, section 5.3); mp4 wants NAL units with their length in front (ISO/IEC 14496-15) and AV1 without
temporal delimiters (AV1-ISOBMFF, section 2.4).
"""

from __future__ import annotations

import struct
from itertools import accumulate, pairwise

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import ExportError
from demorec.mcap.video import is_keyframe

_AV1_SEQUENCE_HEADER = 1
_AV1_TEMPORAL_DELIMITER = 2
_H264_IDR = 5
_PARAMETER_SETS = {"h264": (7, 8), "hevc": (32, 33, 34)}


def mp4_samples(
    codec: str, data: bytes, lengths: NDArray[np.int64]
) -> tuple[bytes, NDArray[np.int64], NDArray[np.bool_]]:
    """Access units back to back, as an mp4 file stores them; their lengths there; which ones are keyframes.

    Raises:
        ExportError: One of them is none.
    """
    if codec == "h264":
        found = _h264_samples(data, lengths)
        if found is not None:
            return found
    ends = [0, *accumulate(lengths.tolist())]
    units = [data[a:b] for a, b in pairwise(ends)]
    samples = [mp4_sample(codec, unit) for unit in units]
    if not all(samples):
        raise ExportError(f"A packet of the {codec} video holds no picture.")
    sizes = np.array([len(sample) for sample in samples], dtype=np.int64)
    return b"".join(samples), sizes, np.array([is_keyframe(codec, unit) for unit in units], dtype=np.bool_)


def _h264_samples(data: bytes, lengths: NDArray[np.int64]) -> tuple[bytes, NDArray[np.int64], NDArray[np.bool_]] | None:
    """All of an episode at once; None for what encoders do not write, which one access unit at a time sorts out."""
    values = np.frombuffer(data, dtype=np.uint8)
    ends = np.cumsum(lengths)
    begins = ends - lengths
    zeros = np.flatnonzero(values[:-3] == 0)
    codes = zeros[(values[zeros + 1] == 0) & (values[zeros + 2] == 1)]
    unit = np.searchsorted(begins, codes, side="right") - 1
    if not len(codes) or len(np.unique(unit)) != len(lengths):
        return None
    first = np.searchsorted(codes, begins)
    gap = codes[first] - begins
    starts, stops = codes + 3, np.minimum(np.append(codes[1:], len(values)), ends[unit])
    if gap.max() > 1 or values[begins].any() or (starts >= stops).any():
        return None
    # A NAL unit never ends in a zero byte, so zeros before a start code belong to that start code.
    while (padded := values[stops - 1] == 0).any():
        stops = stops - padded
    sizes = stops - starts
    if sizes.min() < 1:
        return None
    view, heads = memoryview(data), sizes.astype(">u4").tobytes()
    parts: list[bytes | memoryview] = []
    for number, (start, stop) in enumerate(zip(starts.tolist(), stops.tolist(), strict=True)):
        parts += (heads[4 * number : 4 * number + 4], view[start:stop])
    is_idr = (values[starts] & 31) == _H264_IDR
    return b"".join(parts), np.add.reduceat(sizes + 4, first), np.logical_or.reduceat(is_idr, first)


def mp4_sample(codec: str, access_unit: bytes) -> bytes:
    """The access unit as an mp4 file stores it; nothing but the framing changes."""
    if codec == "av1":
        return b"".join(
            access_unit[start:end]
            for kind, start, end in _open_bitstream_units(access_unit)
            if kind != _AV1_TEMPORAL_DELIMITER
        )
    parts: list[bytes] = []
    for nal in _nal_units(access_unit):
        parts.append(len(nal).to_bytes(4, "big"))
        parts.append(nal)
    return b"".join(parts)


def parameter_sets(codec: str, access_unit: bytes) -> bytes:
    """What a decoder must know before the first picture: one mp4 file holds one of these.

    Raises:
        ExportError: There is none, so the episode does not start with a keyframe that stands alone.
    """
    if codec == "av1":
        found = b"".join(
            access_unit[start:end]
            for kind, start, end in _open_bitstream_units(access_unit)
            if kind == _AV1_SEQUENCE_HEADER
        )
    else:
        wanted = _PARAMETER_SETS[codec]
        found = b"".join(
            struct.pack(">I", len(nal)) + nal for nal in _nal_units(access_unit) if _nal_type(codec, nal) in wanted
        )
    if not found:
        raise ExportError(f"The {codec} video does not start with a keyframe that carries its parameter sets.")
    return found


def _nal_units(access_unit: bytes) -> list[bytes]:
    before, *pieces = access_unit.split(b"\x00\x00\x01")
    if before.strip(b"\x00") or not pieces:
        raise ExportError("A video packet does not begin with a start code: it is no Annex B stream.")
    return [nal for piece in pieces if (nal := piece.rstrip(b"\x00"))]


def _nal_type(codec: str, nal: bytes) -> int:
    return nal[0] & 31 if codec == "h264" else (nal[0] >> 1) & 63


def _open_bitstream_units(access_unit: bytes) -> list[tuple[int, int, int]]:
    """(type, start, end) of each unit; every one must carry its size, as encoders write them."""
    units = []
    start = 0
    while start < len(access_unit):
        header = access_unit[start]
        if not header & 2:
            raise ExportError("An AV1 packet holds a unit without a size field.")
        position = start + 1 + ((header >> 2) & 1)
        size = shift = 0
        while True:
            byte = access_unit[position]
            position += 1
            size |= (byte & 127) << shift
            shift += 7
            if not byte & 128:
                break
        end = position + size
        if end > len(access_unit):
            raise ExportError("An AV1 packet is cut off.")
        units.append(((header >> 3) & 15, start, end))
        start = end
    return units

"""Recognise videos with a single channel over 8 bits: depth or another measurement instead of colour."""

from __future__ import annotations

import re

from demorec.mcap.video import nal_units

_DEEP_GRAY = re.compile(r"gray(9|1\d|f32)")
"""FFmpeg's single-channel pixel formats over 8 bits."""
_WITH_CHROMA_FORMAT = frozenset((44, 83, 86, 100, 110, 118, 122, 128, 134, 135, 138, 139, 244))
"""H.264 profiles whose parameter sets state the chroma format (ITU-T H.264, 7.3.2.1.1)."""
_SPS_BYTES = 24
"""Maximum length of the fields before and including the bit depth."""


def deep_gray(codec: str, pixel_format: str, parameters: bytes) -> str:
    """Name the pixel format of a video that holds a measurement; "" for colour.

    FFmpeg's `pixel_format` is a colour format for H.264 without chroma, so the video's parameter sets are read too, as
    in an access unit or in an mp4 file.
    """
    if codec == "h264" and (depth := _luma_bits_without_chroma(parameters)) > 8:
        return f"gray{depth}le"
    return pixel_format if _DEEP_GRAY.match(pixel_format) else ""


def _luma_bits_without_chroma(parameters: bytes) -> int:
    """Bits per pixel of H.264 without chroma; 0 for colour, or without a sequence parameter set."""
    is_mp4 = parameters[:1] == b"\x01"  # one set follows its length (ISO/IEC 14496-15, 5.3.3.1)
    begins = [8] if is_mp4 else [place + 3 for kind, place in nal_units("h264", parameters) if kind == 7]
    sps = parameters[begins[0] :][:_SPS_BYTES] if begins else b""
    if len(sps) < _SPS_BYTES // 2 or sps[1] not in _WITH_CHROMA_FORMAT:
        return 0
    bits = "".join(f"{byte:08b}" for byte in sps[4:].replace(b"\0\0\3", b"\0\0"))
    values: list[int] = []  # identifier, chroma format, luma bits over 8, as Exp-Golomb codes
    while len(values) < 3:
        zeros = len(bits) - len(bits.lstrip("0"))
        if 2 * zeros >= len(bits):
            return 0
        values.append(int(bits[: 2 * zeros + 1], 2) - 1)
        bits = bits[2 * zeros + 1 :]
    return values[2] + 8 if values[1] == 0 else 0

"""Distances as ROS's compressed_depth_image_transport codes them: twelve bytes in front of a PNG file or of RVL."""

from __future__ import annotations

import io

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from demorec.config import MAX_PIXELS
from demorec.errors import in_words
from demorec.ingest.fields import FieldError
from demorec.recording.depth import decode_millimetres

_HEAD_BYTES = 12
"""ConfigHeader: a format and two parameters, which mean something for 32FC1 alone."""
_PNG = b"\x89PNG\r\n\x1a\n"


def compressed_depth_head(form: str, data: bytes) -> tuple[str, int, int]:
    """Encoding, width and height of a picture; FieldError when it is none, or does not hold whole millimetres."""
    encoding = form.split(";")[0].strip()
    if encoding != "16UC1":
        raise FieldError(
            f"its compressedDepth is of {encoding[:20]!r}, which does not keep what was measured; 16UC1, and 32FC1 "
            "that is not compressed, are read"
        )
    width, height = _size(data)
    return encoding, width, height


def decode_compressed_depth(data: bytes) -> NDArray[np.uint16]:
    """(H, W) millimetres; FieldError when they cannot be decoded."""
    width, height = _size(data)
    try:
        if data.startswith(_PNG, _HEAD_BYTES):
            with Image.open(io.BytesIO(data[_HEAD_BYTES:]), formats=("PNG",)) as image:
                if image.mode not in ("I;16", "I"):
                    raise ValueError(f"its pixels are {image.mode}, not of 16 bits")
                return np.asarray(image).astype(np.uint16)
        return decode_millimetres(data, (height, width))
    except UnidentifiedImageError as error:
        raise FieldError("its distances cannot be decoded (they are no whole PNG file)") from error
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise FieldError(f"its distances cannot be decoded ({in_words(error)})") from error


def _size(data: bytes) -> tuple[int, int]:
    """Width and height, within bounds."""
    if data.startswith(_PNG, _HEAD_BYTES):
        size = data[_HEAD_BYTES + 16 : _HEAD_BYTES + 24]  # of the first chunk, IHDR
        order = "big"
    else:
        size, order = data[_HEAD_BYTES : _HEAD_BYTES + 8], "little"
    if len(size) < 8:
        raise FieldError("its distances are cut off")
    width, height = (int.from_bytes(size[at : at + 4], order) for at in (0, 4))  # type: ignore[arg-type]
    if not 1 <= width * height <= MAX_PIXELS:
        raise FieldError(f"its picture has {width}x{height} pixels, at most {MAX_PIXELS} are read")
    return width, height

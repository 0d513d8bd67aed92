"""Images of a dataset that are stored in the rows of its data files, PNG or JPEG."""

from __future__ import annotations

import io
from collections.abc import Collection, Iterable, Iterator
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
from PIL import Image

from demorec.core.config import MAX_PIXELS
from demorec.core.errors import ExportError, describe_error
from demorec.datasets.lerobot.episode_table import EpisodePlace
from demorec.datasets.lerobot.rows import DataRows

if TYPE_CHECKING:
    from demorec.mcap.video import Rgb


class StoredImages:
    """The images of a camera feature.

    Args:
        rows: The column of the feature.

    Methods raise ExportError if an image cannot be read.
    """

    def __init__(self, rows: DataRows) -> None:
        self._rows = rows
        (self._key,) = rows.names

    def read(self, place: EpisodePlace, frames: Collection[int] | None = None) -> Iterator[Rgb]:
        """Yield (H, W, 3) uint8 RGB of some frames of an episode, of all by default."""
        columns = (batch.column(self._key) for batch in self._rows.batches(place))
        yield from self.decode(place, columns if frames is None else _some_rows(columns, frames))

    def decode(self, place: EpisodePlace, columns: Iterable[pa.Array]) -> Iterator[Rgb]:
        """Yield (H, W, 3) uint8 RGB of some rows of an episode, from their column."""
        path = place.data
        shape: tuple[int, ...] | None = None
        for column in columns:
            for item in column:
                value = item.as_py()
                data = value.get("bytes") if isinstance(value, dict) else value
                try:
                    image = self._decoded(data or b"")
                    if shape not in (None, image.shape):
                        raise ValueError(f"it has another size, {image.shape[1]}x{image.shape[0]} pixels")
                except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
                    raise ExportError(
                        f"An image of {self._key} cannot be read ({describe_error(error)}): {path}"
                    ) from error
                shape = image.shape
                yield image

    def _decoded(self, data: bytes) -> Rgb:
        if not data:
            raise ValueError("it is not in the table")
        with Image.open(io.BytesIO(data), formats=("JPEG", "PNG")) as image:
            if image.width * image.height > MAX_PIXELS:
                raise ValueError(f"{image.width}x{image.height} pixels, at most {MAX_PIXELS:,} are read")
            if image.mode not in ("RGB", "RGBA", "L", "P", "1"):
                raise ValueError(f"its pixels are {image.mode!r}, which is not 8-bit colour")
            return np.asarray(image.convert("RGB"))


def _some_rows(columns: Iterable[pa.Array], wanted: Collection[int]) -> Iterator[pa.Array]:
    first = 0
    for column in columns:
        is_wanted = [first + row in wanted for row in range(len(column))]
        yield column.filter(pa.array(is_wanted, pa.bool_()))
        first += len(column)

"""Rows of a dataset's tables by episode: in the data files, with images, and in tables with an `episode_index`."""

from __future__ import annotations

import hashlib
import io
import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from demorec.core.config import MAX_PIXELS
from demorec.core.errors import ExportError, describe_error
from demorec.datasets.lerobot.files import TableReader, column_numbers, column_values, table_batches
from demorec.datasets.lerobot.language import column_digests
from demorec.datasets.lerobot.layout import AUTOMATIC_FEATURES, DatasetInfo
from demorec.datasets.lerobot.paths import INFO_PATH
from demorec.extensions.datasets.episode_places import EpisodePlace

if TYPE_CHECKING:
    from demorec.mcap.video import Rgb

_NUMBERS = ("float32", "float64", "int64", "bool")
OWN_COUNTERS = ("episode_index", "frame_index")
"""Columns that verify the episode of a row."""
_INDEX_ROWS = 4096


class DataRows:
    """Some columns of the data files, for episodes in any order; one batch of a file is in memory.

    Every row is verified by its `episode_index` and, if the file has one, `frame_index`. Missing counters and
    timestamps are derived from the position of the rows.

    Args:
        num_rows: Data file -> number of its episodes' rows.
        task_number: Returns the number of the task of an episode whose rows have none.
        own: Columns that verify the rows, if a file has them.

    Methods raise ExportError if the rows cannot be read, or belong to other episodes.
    """

    def __init__(
        self,
        info: DatasetInfo,
        num_rows: Mapping[Path, int],
        names: Sequence[str],
        *,
        task_number: Callable[[EpisodePlace], int],
        own: Sequence[str],
    ) -> None:
        if missing := [name for name in names if name not in info.features]:
            raise ExportError(f"The dataset has no {', '.join(missing)}, according to {INFO_PATH}")
        self.names = list(names)
        self._fps, self._num_rows, self._task_number, self._own = info.fps, num_rows, task_number, own
        self._features = {name: info.features[name] for name in names}
        kinds = {feature.dtype for feature in self._features.values()}
        max_rows = 16 if "image" in kinds else 64 if kinds & {"string", "language"} else 4096
        self._automatic = [name for name in names if name in AUTOMATIC_FEATURES]
        stored = [name for name in names if name not in AUTOMATIC_FEATURES]
        self._tables = TableReader(stored, optional=[*self._automatic, *self._own], rows=max_rows)

    def batches(self, place: EpisodePlace) -> Iterator[pa.RecordBatch]:
        """Yield the rows of an episode."""
        found = 0
        there, listed = (self._tables.num_rows(place.data), self._num_rows[place.data]) if place.length else (0, 0)
        if there > listed:
            raise ExportError(
                f"The data file has {there} rows, the episodes' table lists only {listed} of them and is "
                f"incomplete: {place.data}"
            )
        for batch in self._tables.read(place.data, place.first_row, place.length) if place.length else ():
            _check_own(batch, place, found, self._own)
            yield self._completed(batch, place, found)
            found += len(batch)
        if found < place.length:
            raise ExportError(
                f"Episode {place.episode_index} has {place.length} frames, but its data file ends earlier: {place.data}"
            )

    def _completed(self, batch: pa.RecordBatch, place: EpisodePlace, begin: int) -> pa.RecordBatch:
        """Add missing counters and timestamps, and convert counters to integers. The first row of the batch is frame
        `begin`.
        """
        frames = np.arange(begin, begin + len(batch))
        for name in self._automatic:
            number = batch.schema.get_field_index(name)
            if number < 0:
                batch = batch.append_column(name, pa.array(self._implied(name, frames, place)))
            elif name != "timestamp" and batch.column(number).type != pa.int64():
                with _column_errors(name, place):
                    batch = batch.set_column(number, name, batch.column(number).cast(pa.int64()))
        return batch

    def _implied(self, name: str, frames: NDArray[np.int64], place: EpisodePlace) -> NDArray[Any]:
        if name == "timestamp":
            return (frames / self._fps).astype(np.float32)
        if name == "task_index":
            return np.full(len(frames), self._task_number(place))
        first = {"frame_index": 0, "index": place.from_index, "episode_index": place.episode_index}[name]
        return first + frames * (name != "episode_index")

    def read(self, place: EpisodePlace) -> pa.Table:
        """Read all rows of an episode. Raises ExportError also if it has none."""
        if not place.length:
            raise ExportError(
                f"Episode {place.episode_index} has no frames, drop this episode: its data file would be {place.data}"
            )
        return pa.Table.from_batches(list(self.batches(place)))

    def numbers(self, place: EpisodePlace) -> dict[str, NDArray[Any]]:
        """Read feature -> (T, D) numbers of an episode as info.json describes them, or (T, 1) texts. For language and
        stored images, the texts are digests of each row.
        """
        parts = [
            [self._values(name, batch.column(name), place) for name in self.names] for batch in self.batches(place)
        ]
        if not parts:
            return {name: np.zeros((0, 1)) for name in self.names}
        columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
        return dict(zip(self.names, columns, strict=True))

    def _values(self, name: str, column: pa.Array, place: EpisodePlace) -> NDArray[Any]:
        feature = self._features[name]
        with _column_errors(name, place):
            if feature.dtype == "language":
                values = column_digests(column)
            elif feature.dtype == "image":
                values = _image_digests(column)
            else:
                values = column_values(column)
        if feature.dtype in _NUMBERS and values.shape[1:] != (math.prod(feature.shape),):
            raise ExportError(
                f"The column {name} has {values.shape[1:]} values, expected {feature.shape}: {place.data}"
            )
        return values


def _check_own(batch: pa.RecordBatch, place: EpisodePlace, begin: int, own: Sequence[str]) -> None:
    expected = {"episode_index": place.episode_index, "frame_index": np.arange(begin, begin + len(batch))}
    for name, numbers in expected.items():
        if name not in own or name not in batch.schema.names:
            continue
        with _column_errors(name, place):
            found = column_values(batch.column(name))[:, 0]
        if len(wrong := np.flatnonzero(found != numbers)):
            raise ExportError(
                f"The rows of episode {place.episode_index} belong to another: frame {begin + int(wrong[0])} has the "
                f"{name} {found[wrong[0]]}. Restore the file, or drop the episode: {place.data}"
            )


@contextmanager
def _column_errors(name: str, place: EpisodePlace) -> Iterator[None]:
    try:
        yield
    except (ValueError, TypeError, LookupError, pa.ArrowException) as error:
        raise ExportError(f"The column {name} holds values that are not numbers: {place.data}") from error


def _image_digests(column: pa.Array) -> NDArray[np.str_]:
    images = column.field("bytes") if pa.types.is_struct(column.type) else column
    digests = [hashlib.sha256(data or b"").hexdigest() for data in images.to_pylist()]
    return np.array(digests, dtype=np.str_).reshape(-1, 1)


class EpisodeTable:
    """Tables with one row for each episode, found by the column `episode_index`.

    Args:
        paths: The tables.
        schema: Columns to read, null if a table lacks one.

    Methods raise ExportError if the tables cannot be read.
    """

    def __init__(self, paths: Sequence[Path], schema: pa.Schema) -> None:
        self._schema = schema
        self._places: dict[int, tuple[Path, int]] = {}
        for path in paths:
            first = 0
            for batch in table_batches(path, ["episode_index"], rows=_INDEX_ROWS):
                episodes = column_numbers(batch.column(0))[:, 0].tolist()
                self._places |= {int(number): (path, first + row) for row, number in enumerate(episodes)}
                first += len(batch)
        self._tables = TableReader(["episode_index"], optional=schema.names)

    def row(self, episode_index: int) -> dict[str, Any]:
        """Read the last row of an episode; empty if it has none."""
        if episode_index not in self._places:
            return {}
        path, number = self._places[episode_index]
        row: dict[str, Any] = dict.fromkeys(self._schema.names)
        for batch in self._tables.read(path, number, 1):
            for item in self._schema:
                if item.name in batch.schema.names:
                    row[item.name] = _cast(batch.column(item.name), item.type, path)[0].as_py()
        return row


def _cast(column: pa.Array, kind: pa.DataType, path: Path) -> pa.Array:
    try:
        return column.cast(kind)
    except (ValueError, pa.ArrowException) as error:
        raise ExportError(f"The table has columns with other types ({describe_error(error)}): {path}") from error


class StoredImages:
    """The images of a camera feature in its column. Methods raise ExportError if an image cannot be read."""

    def __init__(self, rows: DataRows) -> None:
        self._rows = rows
        (self._key,) = rows.names

    def read(self, place: EpisodePlace, frames: Collection[int] | None = None) -> Iterator[Rgb]:
        """Yield (H, W, 3) uint8 RGB of some frames of an episode, of all by default."""
        columns = (batch.column(self._key) for batch in self._rows.batches(place))
        yield from self.decode(place, columns if frames is None else _some_rows(columns, frames))

    def decode(self, place: EpisodePlace, columns: Iterable[pa.Array]) -> Iterator[Rgb]:
        """Yield (H, W, 3) uint8 RGB of some rows of an episode, from their column."""
        from PIL import Image  # most datasets have videos

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
        from PIL import Image

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

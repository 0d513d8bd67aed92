"""A recording as the sequence of its frames, at home in notebooks."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from functools import cached_property
from typing import TYPE_CHECKING, overload

from demorec.episode.episode import Frame, SimulatedColumns
from demorec.mcap.frames import frames_of, frames_with_images, images_at
from demorec.mcap.notebook import described, frame_table, html_page
from demorec.mcap.reader import RecordingReader

if TYPE_CHECKING:
    import pandas as pd


class SimulatedRecording(RecordingReader):
    """Context manager over one recording, and the sequence of its frames.

    `for frame in recording` gives numbers and pictures together, `recording[120]`, `recording[-1]` and
    `recording[::30]` any of them; `columns` gives all numbers at once, which is much faster where pictures are not
    needed.
    """

    def __len__(self) -> int:
        return self.num_frames

    def __iter__(self) -> Iterator[Frame]:
        return frames_with_images(self)

    @overload
    def __getitem__(self, index: int) -> Frame: ...

    @overload
    def __getitem__(self, index: slice) -> list[Frame]: ...

    def __getitem__(self, index: int | slice) -> Frame | list[Frame]:
        if isinstance(index, slice):
            return [self[number] for number in range(self.num_frames)[index]]
        columns, frames = self._numbers
        frame = frames[index]
        return dataclasses.replace(frame, images=images_at(self, columns, frame.frame_index))

    @cached_property
    def _numbers(self) -> tuple[SimulatedColumns, list[Frame]]:
        """All numbers, kept from the first frame on that is asked for."""
        columns = self.columns()
        return columns, list(frames_of(self, columns))

    def __repr__(self) -> str:
        return f"Recording({str(self.path)!r}: {described(self)})"

    def _repr_html_(self) -> str:
        return html_page(self)

    def to_pandas(self) -> pd.DataFrame:
        """All numbers as a table, one row a frame; see `demorec.mcap.notebook.frame_table`.

        Raises:
            MissingDependencyError: pandas is not installed.
        """
        return frame_table(self)

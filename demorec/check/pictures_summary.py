"""One pass over a camera's pictures: all that any check needs of them, so that they are decoded once."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.check.cells import CellGrid, Cells, ImageKind, PictureCells
from demorec.errors import RecordingError
from demorec.geometry import Array
from demorec.recording import Recording
from demorec.scene.scene import Camera


@dataclass(frozen=True, kw_only=True, eq=False)
class PictureSummary:
    """What is known of N pictures of a camera after decoding them.

    Attributes:
        error: Why decoding ended early, or "".
        mean: (N, 3) mean colour, 0..255; of the brightnesses that stand for depth and labels, (N, channels).
        dark, bright: (N,) share of pixels that are nearly black or nearly white.
        cells: (N, h, w, channels) means over small areas, 0..255.
    """

    error: str
    mean: Array
    dark: Array
    bright: Array
    cells: Cells

    @property
    def num_pictures(self) -> int:
        """N: how many could be decoded."""
        return len(self.cells)


def summarise(recording: Recording, camera: Camera, kind: ImageKind) -> PictureSummary:
    """Decode all pictures of a camera once."""
    read: dict[ImageKind, Callable[[str], Iterator[NDArray[Any]]]] = {
        "color": recording.images,
        "depth": recording.depth,
        "labels": recording.segmentation,
    }
    grid = CellGrid(camera.width, camera.height)
    found: list[PictureCells] = []
    error = ""
    try:
        for picture in read[kind](camera.name):
            found.append(grid.read(kind, picture))  # what came before the damage counts
    except RecordingError as problem:
        error = str(problem)
    return PictureSummary(
        error=error,
        mean=np.array([picture.mean for picture in found]),
        dark=np.array([picture.dark for picture in found]),
        bright=np.array([picture.bright for picture in found]),
        cells=np.array([picture.cells for picture in found]) if found else np.empty((0, 2, 2, 1), dtype=np.float32),
    )

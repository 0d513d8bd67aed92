"""The images of a camera, decoded once and summed up for all checks that look at them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.check.cells import CellGrid, Cells, ImageKind, PictureCells
from demorec.core.errors import RecordingError
from demorec.core.geometry import Array
from demorec.episode.scene import SceneCamera
from demorec.mcap import Recording


@dataclass(frozen=True, kw_only=True, eq=False)
class PictureSummary:
    """What is known of N pictures of a camera after decoding them.

    Attributes:
        error: Why decoding ended early, or "".
        mean: (N, 3) mean colour, 0..255; of the brightnesses that stand for depth and labels, (N, channels).
        dark, bright: (N,) share of pixels that are nearly black or nearly white.
        cells: (N, h, w, channels) means over small areas, 0..255.
        detail: (N,) how much fine structure colours have.
        kept: Frame -> some of the pictures as they are.
    """

    error: str
    mean: Array
    dark: Array
    bright: Array
    cells: Cells
    detail: NDArray[np.float32]
    kept: Mapping[int, NDArray[Any]] = field(default_factory=dict)

    @property
    def num_pictures(self) -> int:
        """N: how many could be decoded."""
        return len(self.cells)


def summarise(recording: Recording, camera: SceneCamera, kind: ImageKind, keep: Collection[int] = ()) -> PictureSummary:
    """Decode all pictures of a camera once, and keep those of some frames."""
    from demorec.check import kernels

    read: dict[ImageKind, Callable[[str], Iterator[NDArray[Any]]]] = {
        "color": recording.images,
        "depth": recording.depth,
        "labels": recording.segmentation,
    }
    grid = CellGrid(camera.width, camera.height)
    found: list[PictureCells] = []
    detail: list[float] = []
    kept: dict[int, NDArray[Any]] = {}
    error = ""
    try:
        for frame, picture in enumerate(read[kind](camera.name)):
            found.append(grid.read(kind, picture))  # what came before the damage counts
            detail.append(kernels.amount_of_detail(picture) if kind == "color" else 0.0)
            if frame in keep:
                kept[frame] = picture
    except RecordingError as problem:
        error = str(problem)
    return PictureSummary(
        error=error,
        mean=np.array([picture.mean for picture in found]),
        dark=np.array([picture.dark for picture in found]),
        bright=np.array([picture.bright for picture in found]),
        cells=np.array([picture.cells for picture in found]) if found else np.empty((0, 2, 2, 1), dtype=np.float32),
        detail=np.array(detail, dtype=np.float32),
        kept=kept,
    )

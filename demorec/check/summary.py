"""The images of a camera, decoded once and summed up for all checks that look at them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.check.cells import CellGrid, Cells, ImageCells, ImageKind
from demorec.core.errors import RecordingError
from demorec.core.geometry import Array
from demorec.episode.scene import SceneCamera
from demorec.mcap import Recording


@dataclass(frozen=True, kw_only=True, eq=False)
class ImageSummary:
    """What is known of N images of a camera after decoding them.

    Attributes:
        error: Why decoding ended early, or "".
        mean: (N, 3) mean colour, 0..255; of the brightnesses that stand for depth and labels, (N, channels).
        dark, bright: (N,) share of pixels that are nearly black or nearly white.
        cells: (N, h, w, channels) means over small areas, 0..255.
        detail: (N,) how much fine structure colours have.
        kept: Frame -> some of the images as they are.
    """

    error: str
    mean: Array
    dark: Array
    bright: Array
    cells: Cells
    detail: NDArray[np.float32]
    kept: Mapping[int, NDArray[Any]] = field(default_factory=dict)

    @property
    def num_images(self) -> int:
        """N: how many could be decoded."""
        return len(self.cells)


def summarise(recording: Recording, camera: SceneCamera, kind: ImageKind, keep: Collection[int] = ()) -> ImageSummary:
    """Decode all images of a camera once, and keep those of some frames."""
    from demorec.check import kernels

    read: dict[ImageKind, Callable[[str], Iterator[NDArray[Any]]]] = {
        "color": recording.images,
        "depth": recording.depth,
        "labels": recording.segmentation,
    }
    grid = CellGrid(camera.width, camera.height)
    found: list[ImageCells] = []
    detail: list[float] = []
    kept: dict[int, NDArray[Any]] = {}
    error = ""
    try:
        for frame, image in enumerate(read[kind](camera.name)):
            found.append(grid.read(kind, image))  # what came before the damage counts
            detail.append(kernels.amount_of_detail(image) if kind == "color" else 0.0)
            if frame in keep:
                kept[frame] = image
    except RecordingError as problem:
        error = str(problem)
    return ImageSummary(
        error=error,
        mean=np.array([image.mean for image in found]),
        dark=np.array([image.dark for image in found]),
        bright=np.array([image.bright for image in found]),
        cells=np.array([image.cells for image in found]) if found else np.empty((0, 2, 2, 1), dtype=np.float32),
        detail=np.array(detail, dtype=np.float32),
        kept=kept,
    )

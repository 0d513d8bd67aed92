"""Images in cells: the compiled loops give what NumPy gives, drawn images have the grid of the recorded ones."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from demorec.check.cells import CellGrid, cell_counts, cell_side
from demorec.check.drawn import small_camera
from demorec.core.errors import RecordingError
from demorec.core.geometry import Pose
from demorec.episode.scene import SceneCamera


def parts(image: NDArray[Any], width: int, height: int) -> list[list[NDArray[Any]]]:
    """The image cut into its cells."""
    columns, rows = cell_counts(width, height)
    side = min(width // columns, height // rows)
    left, top = (width - columns * side) // 2, (height - rows * side) // 2
    x, y = [left + j * side for j in range(columns + 1)], [top + i * side for i in range(rows + 1)]
    return [[image[y[i] : y[i + 1], x[j] : x[j + 1]] for j in range(columns)] for i in range(rows)]


@given(width=st.integers(4, 90), height=st.integers(4, 90), seed=st.integers(0, 9))
@settings(max_examples=25)
def test_colours_are_means_of_the_cells_and_of_all(width: int, height: int, seed: int) -> None:
    image = np.random.default_rng(seed).choice([0, 11, 12, 90, 250, 251, 255], (height, width, 3)).astype(np.uint8)
    read = CellGrid(width, height).read("color", image)
    expected = [[cell.mean(axis=(0, 1)) for cell in row] for row in parts(image, width, height)]
    np.testing.assert_allclose(read.cells, expected, rtol=1e-6)
    np.testing.assert_allclose(read.mean, image.mean(axis=(0, 1)), rtol=1e-12)
    grey = image.astype(np.float64).mean(axis=2)
    assert read.dark == pytest.approx((grey < 12 - 1e-9).mean())
    assert read.bright == pytest.approx((grey > 250 + 1e-9).mean())


def test_a_image_of_another_size_is_refused() -> None:
    """The compiled loops would read beyond its end."""
    with pytest.raises(RecordingError, match=r"\(40, 64, 3\).*\(48, 64, 3\)"):
        CellGrid(64, 48).read("color", np.zeros((40, 64, 3), dtype=np.uint8))


@given(width=st.integers(40, 2000), height=st.integers(40, 2000))
@example(848, 480)
@example(854, 480)
@example(137, 526)
@example(170, 417)
@example(84, 373)
def test_cells_are_squares_in_the_middle(width: int, height: int) -> None:
    columns, rows = counts = cell_counts(width, height)
    side = cell_side(width, height, counts)
    assert columns * rows <= 36 * 36
    # The least of all sizes from 40 to 2000: 85.6 % of images up to 5:2, 77.5 % of those up to 5:1.
    ratio = max(width, height) / min(width, height)
    least = 0.85 if ratio < 2.5 else 0.77 if ratio < 5 else 0.6
    assert columns * rows * side**2 > least * width * height
    # A camera with few pixels sees just that: the same direction at the edges of the grid.
    camera = SceneCamera(name="front", mount="world", mount_from_camera=Pose(), width=width, height=height, fov_y=1.0)
    few = small_camera(camera, counts, 3)
    assert few.width == few.height * columns / rows
    for place in (0, 1):
        edge = counts[place] * side / 2 / camera.intrinsics[place, place]
        assert (few.width, few.height)[place] / 2 / few.intrinsics[place, place] == pytest.approx(edge)

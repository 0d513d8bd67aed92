"""Pictures in cells: the compiled loops give what NumPy gives, drawn pictures have the grid of the recorded ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from support.recording import write_episode

from demorec.check.cells import DEPTH_RANGE, CellGrid, Cells, cell_counts, cell_side
from demorec.check.drawn import compare, frames_to_draw, small_camera
from demorec.check.episode_drawn import draw_episode
from demorec.core.errors import RecordingError
from demorec.core.geometry import Array, Pose
from demorec.episode.scene import SceneCamera
from demorec.mcap import SimulatedRecording


def parts(picture: NDArray[Any], width: int, height: int) -> list[list[NDArray[Any]]]:
    """The picture cut into its cells."""
    columns, rows = cell_counts(width, height)
    side = min(width // columns, height // rows)
    left, top = (width - columns * side) // 2, (height - rows * side) // 2
    x, y = [left + j * side for j in range(columns + 1)], [top + i * side for i in range(rows + 1)]
    return [[picture[y[i] : y[i + 1], x[j] : x[j + 1]] for j in range(columns)] for i in range(rows)]


@given(width=st.integers(4, 90), height=st.integers(4, 90), seed=st.integers(0, 9))
@settings(max_examples=25, deadline=None)
def test_colours_are_means_of_the_cells_and_of_all(width: int, height: int, seed: int) -> None:
    picture = np.random.default_rng(seed).choice([0, 11, 12, 90, 250, 251, 255], (height, width, 3)).astype(np.uint8)
    read = CellGrid(width, height).read("color", picture)
    expected = [[cell.mean(axis=(0, 1)) for cell in row] for row in parts(picture, width, height)]
    np.testing.assert_allclose(read.cells, expected, rtol=1e-6)
    np.testing.assert_allclose(read.mean, picture.mean(axis=(0, 1)), rtol=1e-12)
    grey = picture.astype(np.float64).mean(axis=2)
    assert read.dark == pytest.approx((grey < 12 - 1e-9).mean())
    assert read.bright == pytest.approx((grey > 250 + 1e-9).mean())


def test_depth_is_a_brightness_and_what_was_not_hit_is_far() -> None:
    metres = np.random.default_rng(0).uniform(0.2, 2 * DEPTH_RANGE, (48, 64)).astype(np.float32)
    metres[::3, ::2], metres[1, 1], metres[2, 2] = 0.0, np.nan, np.inf
    read = CellGrid(64, 48).read("depth", metres)
    near = np.where((metres > 0) & (metres < DEPTH_RANGE), metres, DEPTH_RANGE) * (255 / DEPTH_RANGE)
    expected = [[[cell.mean()] for cell in row] for row in parts(near, 64, 48)]
    np.testing.assert_allclose(read.cells, expected, rtol=1e-5)


def test_neighbouring_labels_are_far_apart() -> None:
    """Every two of 20 bodies with 12 links differ by more than four of 255 in one of their two brightnesses."""
    grid = CellGrid(2, 2)
    labels = [body + (link << 24) for body in range(-1, 20) for link in range(12)]
    seen = np.array([grid.read("labels", np.full((2, 2), label, dtype=np.int32)).mean for label in labels])
    apart = np.abs(seen[:, None] - seen[None]).max(axis=2) + 255 * np.eye(len(labels))
    assert (apart > 4).mean() > 0.995
    assert (apart > 0).all()


def test_a_picture_of_another_size_is_refused() -> None:
    """The compiled loops would read beyond its end."""
    with pytest.raises(RecordingError, match=r"\(40, 64, 3\).*\(48, 64, 3\)"):
        CellGrid(64, 48).read("color", np.zeros((40, 64, 3), dtype=np.uint8))


def test_drawn_pictures_have_the_grid_of_the_recorded_ones(tmp_path: Path) -> None:
    """500x224 is drawn as 93x42: by itself that would have another grid."""
    path = write_episode(tmp_path / "e.mcap", num_frames=2, cameras=("front",), width=500, height=224)
    with SimulatedRecording(path) as recording:
        drawn = draw_episode(recording.info, recording.columns(), {"front": ("color",)}).pictures
    assert drawn.cells["front", "color"].shape == (2, 14, 31, 3)


def waves(x: Array, y: Array, t: Array) -> Cells:
    """Smooth pictures as cells (T, h, w, 3), of standing waves: what changes in them is no shift."""
    channels = [np.sin(0.31 * x + 0.2 * y + k) * np.sin(0.2 * t + 2 * k) + np.cos(0.2 * x - 0.3 * y) for k in range(3)]
    return np.asarray(np.stack(channels, axis=-1) * 50 + 127, dtype=np.float32)


T, Y, X = np.meshgrid(np.arange(60.0), np.arange(28.0), np.arange(28.0), indexing="ij")
MIDDLE = 13.5


def test_a_known_shift_and_size_are_measured() -> None:
    """The pictures are shifted by 0.1 cells to the right and 0.05 up, and things in them are 2 % larger."""
    seen = waves((X - 0.1 - MIDDLE) / 1.02 + MIDDLE, (Y + 0.05 - MIDDLE) / 1.02 + MIDDLE, T)
    found = compare(seen, waves(X, Y, T), np.arange(60))
    assert found.shift * 28 == pytest.approx([0.1, -0.05], abs=0.02)
    assert found.scale == pytest.approx(0.02, abs=0.004)


def test_a_known_lag_is_measured() -> None:
    found = compare(waves(X, Y, T - 2.3), waves(X, Y, T), np.arange(60))
    assert found.lag == pytest.approx(2.3, abs=0.1)


def test_frames_are_drawn_that_are_not_what_lies_between_their_neighbours() -> None:
    """Every third frame and the last; a picture that jumps, and a pose that does, though no picture shows it."""
    seen = np.full((14, 4, 4, 3), 100.0, dtype=np.float32) + np.arange(14, dtype=np.float32)[:, None, None, None]
    poses = np.zeros((14, 2, 7))
    poses[:, 1, 0] = 0.02 * np.arange(14)  # an even motion lies between
    assert frames_to_draw([seen], poses).tolist() == [0, 3, 6, 9, 12, 13]
    odd = seen.copy()
    odd[7] += 3.0
    assert frames_to_draw([seen, odd], poses).tolist() == [0, 3, 6, 7, 9, 12, 13]
    poses[5, 1, 2] = 0.006
    assert frames_to_draw([seen], poses).tolist() == [0, 3, 5, 6, 9, 12, 13]


def test_frames_are_drawn_that_the_neighbours_drawn_at_last_do_not_tell() -> None:
    """4 lies between 3 and 6, but not between 3 and 5, which is odd and therefore drawn."""
    seen = np.full((7, 4, 4, 3), 100.0, dtype=np.float32)
    seen[5] += 8.0
    seen[4] += 1.0
    assert frames_to_draw([seen], np.zeros((7, 1, 7))).tolist() == [0, 3, 4, 5, 6]


def test_frames_without_a_readable_neighbour_are_drawn() -> None:
    """The camera's pictures end after frame 7: nothing tells 7 from both sides."""
    poses = np.zeros((14, 1, 7))
    assert frames_to_draw([np.zeros((8, 4, 4, 3), dtype=np.float32)], poses).tolist() == [0, 3, 6, 7, 9, 12, 13]


def test_pictures_that_are_not_drawn_are_means_of_those_around(tmp_path: Path) -> None:
    """Against the same episode drawn in every frame, whose joints move evenly."""
    path = write_episode(tmp_path / "e.mcap", num_frames=5, cameras=("front",), width=64, height=64)
    with SimulatedRecording(path) as recording:
        info, columns = recording.info, recording.columns()
        whole = draw_episode(info, columns, {"front": ("color",)}).pictures.cells["front", "color"]
        still = np.zeros_like(whole)
        drawn = draw_episode(info, columns, {"front": ("color",)}, {"front": still}, draw_each=False).pictures
    found = drawn.cells["front", "color"]
    assert drawn.frames.tolist() == [0, 3, 4]
    for frame in drawn.frames.tolist():
        np.testing.assert_array_equal(found[frame], whole[frame])
    np.testing.assert_allclose(found[1], (2 * whole[0] + whole[3]) / 3, atol=1e-3)
    np.testing.assert_allclose(found[2], (whole[0] + 2 * whole[3]) / 3, atol=1e-3)


@pytest.mark.parametrize(
    ("width", "height", "expected"),
    [
        (224, 224, (28, 28)),
        (128, 128, (32, 32)),
        (96, 96, (32, 32)),
        (64, 64, (32, 32)),
        (640, 480, (32, 24)),
        (320, 240, (32, 24)),
        (480, 640, (24, 32)),
        (1280, 720, (32, 18)),
        (854, 480, (25, 14)),  # nothing divides it: two rows or columns of pixels are left over on each side
        (500, 224, (31, 14)),
        (2, 2, (2, 2)),
    ],
)
def test_sizes_are_cut_into_squares(width: int, height: int, expected: tuple[int, int]) -> None:
    assert cell_counts(width, height) == expected


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
    # The least of all sizes from 40 to 2000: 85.6 % of pictures up to 5:2, 77.5 % of those up to 5:1.
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

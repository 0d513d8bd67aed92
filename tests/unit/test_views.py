"""What a fixed camera shows in the episodes of a dataset, on made-up views: a room, and a thing that lies elsewhere."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from demorec.check.base import Measurement
from demorec.check.films import Film
from demorec.check.over_time import exchanged_cameras
from demorec.check.repeats import frozen_images
from demorec.check.views import views_alike, views_stay

Views = NDArray[np.float64]


def room(count: int, seed: int) -> Views:
    """(N, 28, 28, 3) views of the same soft shapes, with a dark square at another place in each."""
    rng = np.random.default_rng(seed)
    walls = 60 + 120 * ndimage.zoom(rng.random((7, 7, 3)), (4, 4, 1), order=1)
    views = np.repeat(walls[None], count, axis=0)
    for view in views:
        row, column = rng.integers(4, 20, 2)
        view[row : row + 4, column : column + 4] = 30
    return views


def values(law: Any, views: Views, detail: Sequence[float] = ()) -> list[float]:
    """What a law finds in a dataset whose films show these views, 30 images each, of so much detail."""
    films = [
        Film(
            where=f"front, episode {number}",
            fps=10,
            cells=np.repeat(np.rint(view)[None], 30, axis=0).astype(np.uint8),
            detail=np.full(30, detail[number] if detail else 1.0),
            frames=np.arange(30),
            state=None,
        )
        for number, view in enumerate(views)
    ]
    rows = [{"task_index": np.zeros(30, dtype=np.int64)}] * len(films)
    found = law.measure(SimpleNamespace(films={"front": films}, rows=rows))
    found = [found] if isinstance(found, Measurement) else list(found)
    return [each.value for each in found]


def moved(views: Views, parts: float) -> Views:
    return np.asarray(ndimage.shift(views, (0, parts, 0, 0), order=1, mode="nearest"))


@pytest.mark.parametrize("seed", range(5))
def test_a_camera_that_was_nudged_between_two_sessions(seed: int) -> None:
    """By half a 28th of the image's height."""
    views = room(12, seed)
    assert max(values(views_stay, views)) < 3
    assert max(values(views_stay, np.concatenate([views[:6], moved(views[6:], 0.5)]))) > 3.5


@pytest.mark.parametrize("seed", range(5))
def test_another_light_moves_no_edges(seed: int) -> None:
    views = room(12, seed)
    assert max(values(views_stay, np.concatenate([views[:6], 0.98 * views[6:]]))) < 3.5


@pytest.mark.parametrize("seed", range(5))
def test_a_camera_that_was_nudged_before_one_episode(seed: int) -> None:
    views = room(8, seed)
    assert values(views_alike, views) == [0]
    assert values(views_alike, np.concatenate([views[:3], moved(views[3:4], 0.5), views[4:]])) == [1]


@pytest.mark.parametrize("seed", range(5))
def test_a_camera_out_of_focus_in_one_episode(seed: int) -> None:
    """Which takes four fifths of the mean square of the detail, where light makes it differ by a twentieth."""
    rng = np.random.default_rng(seed)
    views, detail = np.repeat(room(1, seed), 8, axis=0), (200 * rng.uniform(0.95, 1.05, 8)).tolist()
    assert values(views_alike, views, detail) == [0]
    assert values(views_alike, views, [*detail[:5], 0.2 * detail[5], *detail[6:]]) == [1]


@pytest.mark.parametrize("seed", range(5))
def test_what_is_nearer_has_more_detail_and_more_contrast(seed: int) -> None:
    views, shares = room(8, seed), np.random.default_rng(seed).uniform(0.3, 1.0, 8)
    nearer = 100 + shares[:, None, None, None] * (views - 100)
    assert values(views_alike, nearer, (200 * shares**2).tolist()) == [0]


def test_images_of_a_single_row_of_parts_have_no_edges() -> None:
    assert values(views_alike, room(8, 0)[:, :1]) == [0]


def test_cameras_exchanged_in_one_episode_where_one_hardly_moves_and_is_not_always_still() -> None:
    """By how little the views of one change, with a light and things that differ from one episode to the next."""
    rng = np.random.default_rng(0)
    unrest = {"front": [0.015, 0.3, 0.01, 0.031], "wrist": [0.3, 0.015, 0.2, 0.3]}
    where = {"front": [0, 1, 2, 3], "wrist": [4, 5, 6, 7]}

    def film(camera: str, number: int) -> Film:
        view = room(1, where[camera][number])[0]
        cells = view * (1 + rng.normal(0, unrest[camera][number], (40, *view.shape)))
        return Film(where=f"{camera}, episode {number}", fps=10, cells=np.clip(np.rint(cells), 0, 255).astype(np.uint8),
                    detail=np.ones(40), frames=np.arange(40), state=None)  # fmt: skip

    films = {camera: [film(camera, number) for number in range(4)] for camera in unrest}

    found = exchanged_cameras.measure(SimpleNamespace(films=films))
    assert isinstance(found, Measurement)
    assert (found.value, found.detail) == (40, "front, episode 1 and wrist")
    for camera, shown in films.items():
        shown[1] = film(camera, 0)
    found = exchanged_cameras.measure(SimpleNamespace(films=films))
    assert isinstance(found, Measurement)
    assert found.value == 0


@pytest.mark.parametrize("hangs_at", [20, 110])
def test_a_short_hang_is_found_beside_a_longer_rest(hangs_at: int) -> None:
    """A square goes with the robot, which rests for three seconds between two motions; the camera hangs for 1.2 s."""
    where = np.concatenate([np.arange(60), np.full(30, 60), np.arange(60, 120)]) / 120
    images = np.full((len(where), 28, 28, 3), 90, dtype=np.uint8)
    moves = np.gradient(where) > 0
    images[moves] += np.random.default_rng(0).integers(0, 3, images[moves].shape, dtype=np.uint8)
    for image, place in zip(images, where, strict=True):
        image[10:16, round(22 * place) : round(22 * place) + 6] = 200

    def seconds(cells: NDArray[np.uint8]) -> float:
        film = Film(where="front", fps=10, cells=cells, detail=np.ones(len(cells)), frames=np.arange(len(cells)),
                    state=where[:, None])  # fmt: skip
        found = frozen_images.measure(SimpleNamespace(films={"front": [film]}))
        assert isinstance(found, Measurement)
        return found.value

    assert seconds(images) < 0.33
    hung = images.copy()
    hung[hangs_at : hangs_at + 12] = hung[hangs_at]
    assert seconds(hung) == pytest.approx(1.1)

"""Every sample of a mesh is covered exactly once, for any triangles."""

from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull, Delaunay, QhullError

from demorec.render.raster.batch import merge
from demorec.render.raster.kernels import layout
from demorec.render.raster.kernels.triangles import draw_casters

SIZE = 96
"""Samples: room for triangles on both sides of the limit of a narrow one."""


def hits(corners: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """(SIZE, SIZE) whether each sample is covered by a triangle (3, 2) in units of 1/256 samples."""
    vertices = np.zeros((3, 8))
    geometry = merge([vertices], [np.array([[0, 1, 2]])])
    place = layout.addresses(3)
    geometry.vertices[place + layout.SCREEN_X] = corners[:, 0]
    geometry.vertices[place + layout.SCREEN_Y] = corners[:, 1]
    geometry.vertices[place + layout.INVERSE_W] = 1.0
    heights = np.zeros((SIZE, SIZE), dtype=np.float32)
    draw_casters(
        0,
        1,
        geometry,
        SIZE,
        heights.reshape(-1),
        np.zeros((SIZE // 8, SIZE // 8), dtype=np.uint8),
        False,
        np.zeros(4, dtype=np.int64),
        np.zeros(1, dtype=np.int32),
    )
    return heights > 0


# Coarse steps put many corners and edges exactly on sample centres, where a wrong fill rule shows.
@settings(max_examples=40)
@given(
    st.lists(st.tuples(st.integers(-4, 200), st.integers(-4, 200)), min_size=4, max_size=14, unique=True),
    st.sampled_from([128, 64, 37]),
)
def test_a_mesh_covers_every_sample_once(points: list[tuple[int, int]], step: int) -> None:
    corners = np.array(points, dtype=np.int64) * step
    try:
        mesh = Delaunay(corners)
    except QhullError:
        return  # all on one line
    count = np.sum([hits(corners[triangle]) for triangle in mesh.simplices], axis=0)
    assert count.max(initial=0) <= 1
    middle = np.arange(SIZE) * 256 + 128
    x, y = np.meshgrid(middle, middle)
    places = np.stack([x, y], -1).reshape(-1, 2)
    # Signed distance to the hull, in 1/256 samples; border samples belong to one side or the other.
    equations = ConvexHull(corners).equations
    distance = (places @ equations[:, :2].T + equations[:, 2]).max(1).reshape(SIZE, SIZE)
    assert (count[distance < -1e-6] == 1).all()
    assert (count[distance > 1e-6] == 0).all()

"""Several processes start at once on an empty cache: all draw, and the cache is filled once."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

PROCESSES = 3
PROGRAM = """
import hashlib, json, sys
from support import render as scenes
from demorec.render.raster import RasterRenderer, decimate
from demorec.render.raster.kernels import antialias, records, shade, still, triangles, vertices

decimations = []
simplify = decimate.decimate
decimate.decimate = lambda mesh, target: decimations.append(target) or simplify(mesh, target)
client = scenes.connect()
scenes.add(client, "box", (1.0, 1.0, 0.02))
scenes.add(client, "mesh", (1.0, 1.0, 1.0), fileName=scenes.DATA + "/franka_panda/meshes/visual/link5.obj")
scenes.add(client, "sphere", (0.08,), mass=1.0)
with RasterRenderer() as raster:
    raster.setup(scenes.setup(client, scenes.camera(160, 120)))
    image = scenes.draw(raster, client)["front"]
kernels = [
    value
    for module in (antialias, records, shade, still, triangles, vertices)
    for value in vars(module).values()
    if hasattr(value, "stats")
]
print(json.dumps({
    "image": hashlib.sha256(image.color.tobytes() + image.depth.tobytes()).hexdigest(),
    "colours": len(set(map(bytes, image.color.reshape(-1, 3)))),
    "compiled": sum(sum(kernel.stats.cache_misses.values()) for kernel in kernels),
    "decimated": decimations,
}))
"""


def start(cache: Path) -> subprocess.Popen[str]:
    tests = Path(__file__).parents[1]
    environment = os.environ | {"DEMOREC_CACHE": str(cache), "PYTHONPATH": f"{tests}:{tests.parent}"}
    return subprocess.Popen(
        [sys.executable, "-c", PROGRAM], env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def result(process: subprocess.Popen[str]) -> tuple[dict[str, Any], str]:
    """Standard output and standard error of a process."""
    out, errors = process.communicate(timeout=900)
    assert process.returncode == 0, errors
    return json.loads(out.splitlines()[-1]), errors


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.timeout(900)
def test_processes_that_start_at_once_share_the_first_start(tmp_path: Path) -> None:
    together = [result(process) for process in [start(tmp_path) for _ in range(PROCESSES)]]
    later = result(start(tmp_path))
    results = [found for found, _ in together]
    assert len({found["image"] for found in [*results, later[0]]}) == 1
    assert results[0]["colours"] > 100
    # One compiles and prints a note; the others wait and load the result.
    assert sorted(found["compiled"] > 0 for found in results) == [False] * (PROCESSES - 1) + [True]
    assert sum("Compiling the renderer" in errors for _, errors in together) == 1
    # Each level of detail (one for the image, one for the shadow map) is built by one process.
    levels = [level for found in results for level in found["decimated"]]
    assert len(levels) == len(set(levels)) == 2
    assert later[0]["compiled"] == 0
    assert later[0]["decimated"] == []
    assert "Compiling" not in later[1]

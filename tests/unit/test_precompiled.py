"""Code of compiled functions that comes with the package: only what is fresh is used, and it computes the same."""

from __future__ import annotations

import hashlib
import json
import os
import pickle
import platform
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import llvmlite.binding
import pytest

from demorec.precompiled import ABOUT, LIBRARIES, Bundle
from demorec.render.raster.kernels.jit import BUNDLE as RASTER
from demorec.scene.kinematics_kernels import BUNDLE as KINEMATICS

PROJECT = Path(__file__).parents[2]
BUNDLES = {"raster": RASTER, "kinematics": KINEMATICS}
PROGRAM = """
import hashlib, json, sys
sys.path.insert(0, "tools")
import numpy as np
import precompile
from demorec.precompiled import Bundle
from demorec.render.raster import view
from demorec.render.raster.kernels.jit import BUNDLE as RASTER
from demorec.scene import kinematics
from demorec.scene.kinematics_kernels import BUNDLE as KINEMATICS

if sys.argv[1] == "numba":
    Bundle.fits = False
seen = hashlib.sha256()
draw, path = view.CameraView.draw, kinematics.straight_path

def noted_draw(self, pose):
    images = draw(self, pose)
    seen.update(images.color.tobytes() + images.depth.tobytes() + images.segmentation.tobytes())
    return images

def noted_path(*arguments):
    found = path(*arguments)
    seen.update(found[0].tobytes())
    return found

view.CameraView.draw, kinematics.straight_path = noted_draw, noted_path
precompile.exercise_raster()
precompile.exercise_kinematics()
dispatchers = [*RASTER.dispatchers, *KINEMATICS.dispatchers]
print(json.dumps([seen.hexdigest(), sum(sum(each.stats.cache_misses.values()) for each in dispatchers)]))
"""


@pytest.mark.skipif(platform.machine() != "x86_64", reason="the files are for x86_64; elsewhere Numba compiles")
@pytest.mark.parametrize("name", BUNDLES)
def test_the_files_are_those_of_these_sources(name: str) -> None:
    bundle = BUNDLES[name]
    with zipfile.ZipFile(bundle.path) as file:
        assert json.loads(file.read(ABOUT)) == bundle.about(), "run `make precompiled` and commit its files"


@pytest.mark.parametrize("name", BUNDLES)
def test_the_files_name_no_place_of_the_machine_that_made_them(name: str) -> None:
    """LLVM packs what it holds: only as text are the names in it to be found."""
    with zipfile.ZipFile(BUNDLES[name].path) as file:
        libraries = pickle.loads(file.read(LIBRARIES))
        others = [file.read(member) for member in file.namelist() if member != LIBRARIES]
    code = "".join(str(llvmlite.binding.parse_bitcode(bitcode)) for bitcode, _ in libraries)
    assert "arrayobj.py" in code if name == "raster" else "define" in code
    for text in (code, *(content.decode("latin-1") for content in others)):
        for place in ("site-packages", "/numba/", str(PROJECT), sys.prefix):
            assert place not in text


def _bundle_of(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Bundle:
    """One whose file fits its source."""
    source = folder / "source.py"
    source.write_text("one = 1\n")
    monkeypatch.setattr("demorec.precompiled.FOLDER", folder)
    bundle = Bundle("trial", [source])
    with zipfile.ZipFile(bundle.path, "w") as file:
        file.writestr(ABOUT, json.dumps(bundle.about()))
    return bundle


def test_a_file_of_other_sources_is_not_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert _bundle_of(tmp_path, monkeypatch).fits
    (tmp_path / "source.py").write_text("one = 2\n")
    assert not Bundle("trial", [tmp_path / "source.py"]).fits


@pytest.mark.parametrize("library", ["numba", "llvmlite"])
def test_a_file_of_another_library_is_not_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, library: str) -> None:
    assert _bundle_of(tmp_path, monkeypatch).fits
    monkeypatch.setattr(f"{library}.__version__", "0.0.1")
    assert not Bundle("trial", [tmp_path / "source.py"]).fits


def test_a_damaged_file_is_not_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bundle = _bundle_of(tmp_path, monkeypatch)
    with zipfile.ZipFile(bundle.path, "a") as file:
        file.writestr("code", bytes(range(256)))
    assert Bundle("trial", [tmp_path / "source.py"]).fits
    content = bundle.path.read_bytes()
    place = content.index(bytes(range(256)))
    bundle.path.write_bytes(content[:place] + b"x" + content[place + 1 :])
    assert not Bundle("trial", [tmp_path / "source.py"]).fits


@pytest.mark.parametrize("content", [None, b"", b"no archive"])
def test_without_a_readable_file_numba_compiles(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: bytes | None
) -> None:
    bundle = _bundle_of(tmp_path, monkeypatch)
    bundle.path.unlink()
    if content is not None:
        bundle.path.write_bytes(content)
    monkeypatch.setattr("numba.config.CACHE_DIR", str(tmp_path))

    def twice(number: int) -> int:
        return 2 * number

    compiled = bundle.njit(twice)
    assert compiled(21) == 42
    assert sum(compiled.stats.cache_misses.values()) == 1


def _run(folder: Path, compiler: str) -> Any:
    environment = os.environ | {"DEMOREC_CACHE": str(folder), "NUMBA_CACHE_DIR": str(folder)}
    environment["PYTHONPATH"] = str(PROJECT)
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, compiler],
        cwd=PROJECT,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_both_ways_to_compile_compute_the_same(tmp_path: Path) -> None:
    """From the files nothing is left for Numba to compile, and pictures and paths are the same to the bit."""
    precompiled, misses = _run(tmp_path / "precompiled", "bundle")
    compiled, compiled_misses = _run(tmp_path / "compiled", "numba")
    assert precompiled == compiled
    assert misses == 0 < compiled_misses


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_same_sources_give_the_same_files(tmp_path: Path) -> None:
    (tmp_path / "tools").mkdir()
    for part in ("demorec", "tools"):
        subprocess.run(["cp", "-r", str(PROJECT / part), str(tmp_path)], check=True)
    for bundle in BUNDLES.values():
        (tmp_path / "demorec" / "precompiled" / bundle.path.name).unlink()
    subprocess.run(
        [sys.executable, "tools/precompile.py"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(tmp_path), "PYTHONHASHSEED": "0"},
        check=True,
        capture_output=True,
    )
    for bundle in BUNDLES.values():
        made = tmp_path / "demorec" / "precompiled" / bundle.path.name
        assert hashlib.sha256(made.read_bytes()).digest() == hashlib.sha256(bundle.path.read_bytes()).digest()

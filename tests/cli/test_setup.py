"""`make setup` with and without a C++ compiler.

A stand-in replaces uv. The new environment uses this Python, in which torchcodec cannot be imported.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[2]
PROGRAMS = ("bash", "awk", "cat", "cut", "getconf", "head", "make", "mkdir", "mktemp", "rm", "sleep", "sort", "touch")
UV = f"""#!/bin/bash
case $1 in
  --version) echo "uv 9.9.9" ;;
  venv)
    mkdir -p .venv/bin
    printf '#!/bin/bash\\n[[ $* != *torchcodec* ]] && exec {sys.executable} "$@"\\n' >.venv/bin/python
    chmod +x .venv/bin/python ;;
  pip) echo "$*" >>asked; for word; do case $word in *.override) cat "$word" >>override ;; esac; done ;;
esac
"""


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """Copy the files of the repository that make needs, and set a PATH without a compiler."""
    (tmp_path / "tools").mkdir()
    for name in ("Makefile", "pyproject.toml", "constraints.txt", ".python-version", "tools/setup.sh"):
        shutil.copy(ROOT / name, tmp_path / name)
    shutil.copytree(ROOT / "plugins", tmp_path / "plugins")
    programs = tmp_path / "programs"
    programs.mkdir()
    for name in (*PROGRAMS, "chmod"):
        (programs / name).symlink_to(str(shutil.which(name)))
    (programs / "uv").write_text(UV)
    (programs / "uv").chmod(0o755)
    return tmp_path


def make(checkout: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("MAKE", "PYBULLET"))}
    environment["PATH"] = str(checkout / "programs")
    command = [str(checkout / "programs" / "make"), "SHELL=" + str(checkout / "programs" / "bash"), *arguments]
    return subprocess.run(command, cwd=checkout, env=environment, capture_output=True, text=True, check=False)


@pytest.mark.slow
def test_without_a_compiler_a_fork_replaces_pybullet(checkout: Path) -> None:
    done = make(checkout, "setup")
    assert done.returncode == 0, done.stderr
    assert "pybullet-arm64==3.2.8" in done.stdout
    uninstalled, installed, unusable = (checkout / "asked").read_text().splitlines()
    assert uninstalled.split()[:2] == ["pip", "uninstall"]
    assert uninstalled.split()[-1] == "pybullet"  # the fork owns the same files
    assert "pybullet-arm64==3.2.8" in installed.split()
    assert unusable == "pip uninstall -p .venv torchcodec"
    for plugin in (ROOT / "plugins").iterdir():
        assert f"-e plugins/{plugin.name}/" in installed
    needed = Requirement((checkout / "override").read_text())  # instead of demorec's own dependencies
    assert needed.name == "pybullet"
    assert needed.marker is not None
    assert not needed.marker.evaluate()
    assert make(checkout, "setup").stdout == "make: Nothing to be done for 'setup'.\n"


def test_a_compiler_is_required_for_compiling_pybullet(checkout: Path) -> None:
    done = make(checkout, "setup", "PYBULLET=source")
    assert done.returncode == 2
    assert "install g++ or clang, or use PYBULLET=wheel" in done.stderr
    assert "allowed are source and wheel" in make(checkout, "setup", "PYBULLET=gcc").stderr
    assert not (checkout / "asked").exists()

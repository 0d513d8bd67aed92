"""Run LeRobot's commands as if demorec's plug-ins and stand-ins for hardware were installed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).parents[2]
BENCH = Path(__file__).parent / "lerobot_bench"
PLUGINS = tuple(sorted((ROOT / "plugins").glob("*/pyproject.toml")))
STAND_INS = ("feetech-servo-sdk", "pyserial", "deepdiff", "lerobot_teleoperator_scripted", "lerobot_camera_still")
"""Names of distributions, by which LeRobot looks for installed packages."""


@dataclass(frozen=True, kw_only=True)
class Command:
    """One of LeRobot's commands: its module, its flags, additional environment variables."""

    command: str
    args: Sequence[str]
    env: Mapping[str, str] = field(default_factory=dict)


def plugin_names() -> list[str]:
    return [tomllib.loads(path.read_text())["project"]["name"] for path in PLUGINS]


def run_commands(commands: Sequence[Command], folder: Path) -> str:
    """Run commands in one process, offline, with a home folder in `folder`; returns their output."""
    places = [folder / "installed", BENCH, *(path.parent for path in PLUGINS), ROOT]
    for name in (*STAND_INS, *plugin_names()):
        about = places[0] / f"{name.replace('-', '_')}-1.0.0.dist-info"
        about.mkdir(parents=True, exist_ok=True)
        (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0.0\n")
    env = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(map(str, places)),
        "HF_HOME": str(folder / "hf"),
        "HF_HUB_OFFLINE": "1",
        "OMP_NUM_THREADS": "1",
    }
    result = subprocess.run(
        [sys.executable, BENCH / "mains.py", json.dumps([vars(command) for command in commands])],
        cwd=folder,
        env=env,
        capture_output=True,
        text=True,
        timeout=1500,
        check=False,
    )
    assert result.returncode == 0, result.stdout[-3000:] + result.stderr[-6000:]
    return result.stdout + result.stderr

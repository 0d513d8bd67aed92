"""A row for every command that writes, for `tests/crash/test_commands.py`, and the sources that they read."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from demorec.cli import main
from demorec.core.tables import EXPORTERS
from support.export import export, make_run

SLOW = (pytest.mark.slow,)
LONG = (pytest.mark.slow, pytest.mark.long)
SIMULATED, CUT, OTHER_CUT, HDF5, BAGS, POLICY = "e.mcap", "cut.mcap", "other_cut.mcap", "hdf5.toml", "bags", "policy"
"""Sources that not every command needs; the others have a run and datasets."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """A command that writes.

    Attributes:
        call: Its words; SOURCES is the folder with the sources.
        targets: Paths or patterns of its results in the current folder, each whole or absent.
        needs: Sources other than the run and the datasets.
        old: Command that makes the result to be replaced with `flag`; "" if there is no such flag.
        resumes: Whether an interrupted command keeps finished targets and continues after them.
        surprise: Target that another program makes while the command runs (default: the first).
        keeps: Whether the result is then kept under another name.
        flag: Flag that lets the command replace an existing result.
        program: Function that runs it.
        runs: When the tests run.
    """

    call: str
    targets: tuple[str, ...]
    needs: tuple[str, ...] = ()
    old: str = ""
    resumes: bool = False
    surprise: str = ""
    keeps: bool = True
    flag: str = "--overwrite"
    program: Callable[[list[str]], object] = main
    runs: tuple[pytest.MarkDecorator, ...] = LONG

    @property
    def surprising(self) -> str:
        return self.surprise or self.targets[0]


def _edit(words: str) -> Row:
    """Edit into a new dataset, and over an existing one."""
    return Row(
        call=f"dataset {words} --out new", targets=("new",), old="dataset select SOURCES/dataset --episodes 2 --out new"
    )


def _run(words: str, *, needs: tuple[str, ...] = (), surprise: str = "new/episodes/episode_000001.mcap") -> Row:
    """Import into a run, which continues it."""
    return Row(
        call=f"import {words} --out new",
        targets=("new/episodes/*.mcap",),
        needs=needs,
        surprise=surprise,
        resumes=True,
        keeps=False,
    )


def with_stand_in_policy(words: list[str]) -> None:
    """Evaluate or correct a policy that needs neither LeRobot nor PyTorch."""
    from demorec.extensions.policies import rollouts

    rollouts.MAKE_ROLLOUT = "support.policies:make_rollout"
    main(words)


def without_lerobot(words: list[str]) -> None:
    """Skip the verification by LeRobot, which takes seconds to start."""
    sys.modules["lerobot"] = None  # type: ignore[assignment]
    main(words)


_GENERATE = "generate --num-episodes 2 --workers 1 --no-check --out new"
_POLICY = "--policy SOURCES/policy --action joint --num-episodes 2 --episode-length 12 --workers 1 --out new"

ROWS = {
    "split": Row(
        call="dataset split SOURCES/dataset --shares train=0.7 val=0.3 --seed 1 --out new",
        targets=("new/train", "new/val"),
        old="dataset split SOURCES/dataset --shares train=0.3 val=0.7 --seed 0 --out new",
        surprise="new/val",
        runs=(),
    ),
    "view several": Row(
        call="view SOURCES/run --episodes 0:2 --save new.rrd",
        targets=("new-0000.rrd", "new-0001.rrd"),
        old="view SOURCES/reversed --episodes 0:2 --save new.rrd",
        surprise="new-0001.rrd",
    ),
    **{
        f"export {name}": Row(
            call=f"export {name} SOURCES/run --out new",
            targets=("new",),
            old=f"export {name} SOURCES/run --episodes 1 --out new",
            program=without_lerobot,
            runs=SLOW,
        )
        for name in EXPORTERS.names()
    },
    "recover": Row(
        call="recover SOURCES/cut.mcap --out new.mcap",
        targets=("new.mcap",),
        needs=(CUT, OTHER_CUT),
        old="recover SOURCES/other_cut.mcap --out new.mcap",
        runs=SLOW,
    ),
    "append": Row(
        call="export lerobot SOURCES/run --episodes 1: --no-verify --out new",
        targets=("new",),
        old="export lerobot SOURCES/run --episodes 0 --no-verify --out new",
        flag="--append",
    ),
    "import lerobot": _run("lerobot SOURCES/dataset"),
    "import hdf5": _run("hdf5 SOURCES/demo.hdf5 --mapping SOURCES/hdf5.toml", needs=(HDF5,)),
    "import bags": _run("SOURCES/bags --mapping SOURCES/bags.toml", needs=(BAGS,)),
    "select": _edit("select SOURCES/dataset --episodes 0:2"),
    "drop": _edit("drop SOURCES/dataset --episodes 0"),
    "trim": _edit("trim SOURCES/dataset --head 1"),
    "merge": _edit("merge SOURCES/dataset SOURCES/other"),
    "repair": _edit("repair SOURCES/unfinalized"),
    "cut": _edit("cut SOURCES/dataset --at 0=2 1=3"),
    "rename": _edit("rename SOURCES/dataset action=command"),
    "drop-features": _edit("drop-features SOURCES/dataset next.reward"),
    "set-task": _edit("set-task SOURCES/dataset --task push"),
    "reorder": _edit("reorder SOURCES/dataset --order 2,0,1"),
    "shuffle": _edit("shuffle SOURCES/dataset --seed 1"),
    "report": Row(
        call="report SOURCES/dataset --no-checks --out new.html",
        targets=("new.html",),
        old="report SOURCES/run --no-checks --out new.html",
    ),
    "view": Row(
        call="view SOURCES/run --episodes 0 --save new.rrd",
        targets=("new.rrd",),
        old="view SOURCES/run --episodes 1 --save new.rrd",
    ),
    "render": Row(
        call="render SOURCES/e.mcap --cameras front --workers 1 --out new.mcap",
        targets=("new.mcap",),
        needs=(SIMULATED, OTHER_CUT),
        old="recover SOURCES/other_cut.mcap --out new.mcap",
        resumes=True,
    ),
    "generate": Row(
        call=f"{_GENERATE} --cameras none --no-export",
        targets=("new/episodes/*.mcap",),
        old=f"{_GENERATE} --cameras none --no-export --seed 1",
        surprise="new/episodes/episode_000001.mcap",
        resumes=True,
    ),
    "generate a dataset": Row(
        call=f"{_GENERATE} --cameras front --width 32 --height 32",
        targets=("new/dataset",),
        resumes=True,
        keeps=False,
        program=without_lerobot,
    ),
    "generate again": Row(
        call="generate --config SOURCES/e.mcap --workers 1 --no-check --no-export --out new",
        targets=("new/failed/*.mcap",),  # the source is a failure
        needs=(SIMULATED,),
        surprise="new/failed/episode_000000.attempt_0.mcap",
        resumes=True,
    ),
    "evaluate": Row(
        call=f"evaluate {_POLICY}",
        targets=("new/failed/*.mcap",),
        needs=(POLICY,),
        old=f"evaluate {_POLICY} --seed 1",
        surprise="new/failed/episode_000001.mcap",
        resumes=True,
        program=with_stand_in_policy,
    ),
    "correct": Row(
        call=f"correct {_POLICY} --stray-metres 0 --stray-radians 0",
        targets=("new/episodes/*.mcap",),
        needs=(POLICY,),
        surprise="new/episodes/episode_000001.mcap",
        resumes=True,
        program=with_stand_in_policy,
    ),
}
"""All commands that write."""


def make_base(folder: Path) -> None:
    """Make a run and datasets of minimum size."""
    make_run(folder / "run", (4, 5, 6), cameras=("front",))
    make_run(folder / "reversed", (6, 4, 5), cameras=("front",))
    export(folder / "run", folder / "dataset")
    export(folder / "reversed", folder / "other")
    shutil.copytree(folder / "dataset", folder / "unfinalized")
    shutil.rmtree(folder / "unfinalized/meta/episodes")


def _simulated(folder: Path) -> None:
    from support.check import simulate

    simulate(folder / SIMULATED, fps=10, max_episode_seconds=1.0, cameras=("front",), width=32, height=32)


def _cut(folder: Path, name: str, episode: int) -> None:
    source = folder / f"run/episodes/episode_{episode:06d}.mcap"
    (folder / name).write_bytes(source.read_bytes()[:-400])


def _hdf5(folder: Path) -> None:
    from demorec.extensions.imports.hdf5_suggest import suggested_hdf5_mapping
    from support.hdf5 import write_robomimic

    (folder / HDF5).write_text("\n".join(suggested_hdf5_mapping(write_robomimic(folder / "demo.hdf5"), print)))


def _bags(folder: Path) -> None:
    from support import bag_mappings, bags

    (folder / BAGS).mkdir()
    for number in range(2):
        bags.write_mcap(bags.in_order(bags.so101(0.4 + 0.1 * number)), folder / BAGS / f"{number}.mcap")
    bag_mappings.write_mapping(bag_mappings.SO101, folder / "bags.toml")


def _policy(folder: Path) -> None:
    (folder / POLICY).mkdir()
    (folder / POLICY / "config.json").write_text(json.dumps({"type": "act", "input_features": {}}))


MAKERS: dict[str, Callable[[Path], None]] = {
    SIMULATED: _simulated,
    CUT: lambda folder: _cut(folder, CUT, 0),
    OTHER_CUT: lambda folder: _cut(folder, OTHER_CUT, 1),
    HDF5: _hdf5,
    BAGS: _bags,
    POLICY: _policy,
}

"""Extensions: every command uses those of other packages, a broken one harms nothing, each folder can be deleted."""

from __future__ import annotations

import csv
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from support.export import data_table

from demorec.core.extension import extensions
from demorec.extensions.datasets.inspect import dataset_digest
from demorec.mcap import open_recording

PACKAGE = Path(__file__).parents[1] / "support" / "lab_extension"
SOURCE = Path(__file__).parents[2] / "demorec"
IMPORT = "from demorec.core.extension import Extension"
BROKEN = {
    "raises": ("raise RuntimeError('no licence')", "RuntimeError: no licence"),
    "missing": ("OTHER = 1", "AttributeError"),
    "other kind": ("EXTENSION = 1", "is not a demorec.core.extension.Extension"),
    "clash": (
        f"{IMPORT}\nEXTENSION = Extension(name='x', summary='', tasks={{'pick_place': 'nowhere:Pick'}})",
        "core has tasks with the same name: pick_place",
    ),
    "needs": (
        f"{IMPORT}\nEXTENSION = Extension(name='z', summary='', needs=('y',))",
        "it needs y",
    ),
}
GENERATE = "generate_dataset_main"
OWN = [extension.name for extension in extensions().found if extension.name != "core"]


def install(site: Path, module: str) -> None:
    """Write the metadata that pip writes for a package with an entry point."""
    info = site / f"{module}-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {module}\nVersion: 1.0\n")
    (info / "top_level.txt").write_text(f"{module}\n")
    (info / "entry_points.txt").write_text(f"[demorec.extensions]\n{module} = {module}:EXTENSION\n")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    site = tmp_path_factory.mktemp("site")
    shutil.copytree(PACKAGE, site / PACKAGE.name, ignore=shutil.ignore_patterns("__pycache__"))
    install(site, PACKAGE.name)
    return site


SEVERAL = """
import json, sys
from demorec.cli import main
codes = []
for words in json.loads(sys.argv[1]):
    try:
        codes.append(main(words))
    except SystemExit as end:
        codes.append(end.code)
    print(flush=True)
sys.exit(max(code or 0 for code in codes))
"""


def demorec(path: Path, *words: object, code: int = 0, program: str = "main") -> str:
    """Run a command with a folder prepended to the module path; return its output."""
    start = f"import sys; from demorec.cli import {program} as main; main(sys.argv[1:])"
    return python(path, start, *words, code=code)


def several(path: Path, *calls: Sequence[object]) -> str:
    """Run commands one after the other, all with exit code 0, with an empty line after the output of each."""
    return python(path, SEVERAL, json.dumps([list(map(str, words)) for words in calls]))


def python(path: Path, program: str, *words: object, code: int = 0) -> str:
    """Run a program with a folder prepended to the module path; return its output."""
    paths = [str(path), str(SOURCE.parent)]
    done = subprocess.run(
        [sys.executable, "-c", program, *map(str, words)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(paths), "COLUMNS": "100"},
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
        cwd=path,
    )
    assert done.returncode == code, done.stdout + done.stderr
    return done.stdout + done.stderr


@pytest.fixture(scope="module")
def run(site: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of the package's task, robot and camera."""
    out = tmp_path_factory.mktemp("made") / "run"
    words = ["--task", "lab_pick", "--robot", "lab_panda", "--cameras", "corner", "--width", 64, "--height", 64]
    told = demorec(
        site, *words, "--executor", "bench", "--num-episodes", 1, "--no-export", "--out", out, program=GENERATE
    )
    assert "none failed" in told
    assert "1 episode generated again and compared" in told
    return out


def test_lists_and_help_show_the_names_of_a_package(site: Path) -> None:
    names = {"tasks": "lab_pick", "robots": "lab_panda", "cameras": "corner", "exporters": "labcsv",
             "checks": "late_start", "extensions": "lab"}  # fmt: skip
    calls = [*(["list", table] for table in names), ["--help"], ["import", "--help"], ["explain", "late_start"]]
    told = several(site, *calls, ["generate", "--help"])
    for name in names.values():
        assert f"\n{name} " in f"\n{told}", name
    for words in ("count-frames", "bench", "labcsv (CSV", "A policy learns to wait."):
        assert words in told


def test_a_package_brings_a_task_a_robot_a_camera_and_a_command(site: Path, run: Path) -> None:
    (path,) = (run / "episodes").iterdir()
    with open_recording(path) as recording:
        info, num_frames = recording.info, recording.num_frames
    assert (info.instruction, info.simulated.robot.name) == ("tidy up our table", "lab_panda")
    assert [camera.name for camera in info.cameras] == ["corner"]
    assert info.versions["lab_extension"] == "1.0"
    assert "source of lab_extension.scenes" in info.versions
    assert demorec(site, "count-frames", path) == f"{num_frames} frames\n"


def test_a_package_brings_a_format_and_a_check(site: Path, run: Path, tmp_path: Path) -> None:
    table, again = tmp_path / "cup.labcsv", tmp_path / "again"
    told = several(
        site,
        ("export", "labcsv", run, "--out", table, "--digits", 12),
        ("import", "labcsv", table, "--out", again),
        ("info", table),
    )
    (path,) = (run / "episodes").iterdir()
    rows = np.array(list(csv.reader(table.open()))[1:], dtype=float)
    with open_recording(path) as recording:
        np.testing.assert_allclose(rows[:, 1:], recording.table().features["observation.state"], atol=1e-11)
    assert str(len(rows)) in told.split()
    tables = tmp_path / "tables"
    tables.mkdir()
    for name in ("a.labcsv", "b.labcsv"):
        shutil.copy(table, tables / name)
    (tables / "notes.txt").write_text("cups")
    rows[:5, 1:] = rows[0, 1:]
    late = tmp_path / "late.labcsv"
    late.write_text("time_s,q\n" + "\n".join(",".join(map(repr, row)) for row in rows.tolist()) + "\n")
    judging = [("check", file, "--only", "late_start", "--json") for file in (table, late)]
    told = several(
        site,
        *judging,
        ("import", "labcsv", tables, "--out", tmp_path / "both"),
        ("check", tables, "--only", "late_start"),
    )
    *diagnoses, imported_and_checked = told.split("\n\n", 2)
    assert imported_and_checked.count("2 episodes") >= 2
    for diagnosis, is_late in zip(diagnoses, (False, True), strict=True):
        assert [finding["check"] for finding in json.loads(diagnosis)["findings"]] == ["late_start"] * is_late


def test_a_package_brings_language_and_a_file_of_datasets(site: Path, run: Path, tmp_path: Path) -> None:
    out = tmp_path / "d"
    words = ("export", "lerobot", run, "--out", out, "--no-verify", "--language", "motto", "--frame-counts")
    told = several(site, ("export", "lerobot", "--help-all"), words)
    assert "task_aug motto)" in " ".join(told.replace("│", " ").split())
    assert "Write the episodes' lengths." in told
    (path,) = (run / "episodes").iterdir()
    with open_recording(path) as recording:
        num_frames = recording.num_frames
    assert json.loads((out / "frame_counts.json").read_text()) == [30, num_frames]
    row = data_table(out).column("language_persistent").to_pylist()[0]
    expected = ("motto", "tidiness is everything", float(np.float32((num_frames - 1) / 30)))
    assert [(entry["style"], entry["content"], entry["timestamp"]) for entry in row] == [expected]


def test_broken_extensions_are_named_and_harm_nothing(site: Path, tmp_path: Path) -> None:
    shutil.copytree(site, tmp_path / "site")
    for number, (content, _) in enumerate(BROKEN.values()):
        (tmp_path / "site" / f"broken_{number}.py").write_text(content + "\n")
        install(tmp_path / "site", f"broken_{number}")
    told = demorec(tmp_path / "site", "list", "tasks")
    for _, words in BROKEN.values():
        assert words in told
    assert told.count("left out") == len(BROKEN)
    assert "lab_pick" in told
    assert "stack_three" in told


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [name if name == "datasets" else pytest.param(name, marks=pytest.mark.long) for name in OWN]
)
def test_a_folder_can_be_deleted(name: str, tmp_path: Path) -> None:
    """Without the folder and its dependents, the rest is imported and works, and no list or help mentions it."""
    shutil.copytree(SOURCE, tmp_path / "demorec", ignore=shutil.ignore_patterns("__pycache__"))
    gone = [name, *(each.name for each in extensions().found if name in each.needs)]
    gone += [each.name for each in extensions().found if set(each.needs) & set(gone) and each.name not in gone]
    for folder in gone:
        shutil.rmtree(tmp_path / "demorec" / "extensions" / folder)
    code = (
        "import importlib, pkgutil, demorec\n"
        "for module in pkgutil.walk_packages(demorec.__path__, 'demorec.'):\n"
        "    importlib.import_module(module.name)\n"
        "print(demorec.__file__)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.stdout.startswith(str(tmp_path)), done.stderr
    lists = demorec(tmp_path, "list", "extensions").split()
    assert not set(gone) & set(lists)
    lost = [each for each in extensions().found if each.name in gone]
    commands = [row for each in lost for row in each.commands]
    told = demorec(tmp_path, "--help")
    listed = {line.split()[0] for line in told.splitlines() if line.startswith("  ") and line[2] != " "}
    assert "generate" in listed
    assert not listed & set(commands)
    flags = [f"--{flag.replace('_', '-')}" for each in lost for flag in each.extra_files]
    told = demorec(tmp_path, "export", "lerobot", "--help-all")
    assert "--append" in told
    assert not any(flag in told for flag in flags)
    out = tmp_path / "run"
    words = ["--cameras", "none", "--workers", 1, "--out", out, *(() if name == "datasets" else ("--no-export",))]
    assert "none failed" in demorec(tmp_path, "--num-episodes", 1, *words, program=GENERATE)
    assert "pick_place" in demorec(tmp_path, "info", out)
    if name != "datasets":
        return
    dataset, unread = out / "dataset", "found a LeRobot dataset, which no installed extension reads"
    digest = json.loads((out / "run.json").read_text())["export"]["dataset_digest"]
    assert digest == dataset_digest(dataset)
    assert digest in demorec(tmp_path, "--num-episodes", 1, *words, program=GENERATE)
    assert "moved to" in demorec(tmp_path, "--num-episodes", 2, *words, program=GENERATE)
    assert dataset_digest(out / "unfinished" / "dataset") == digest
    for command in ("info", "view"):
        assert unread in demorec(tmp_path, command, dataset, code=2)
    append = ("export", "lerobot", out, "--out", dataset, "--append")
    assert "No installed extension reads a dataset to append to" in demorec(tmp_path, *append, code=2)
    assert "episode_000001" in demorec(tmp_path, "view", out, "--save", tmp_path / "episode.rrd")

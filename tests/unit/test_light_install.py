"""demorec without LeRobot and PyTorch: everything else works, and commands name the missing package."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from support.commands import exit_code
from support.export import make_run

from demorec.cli import COMMANDS
from demorec.core.errors import ExportError, MissingDependencyError
from demorec.datasets.lerobot.export import export_lerobot, push_to_hub
from demorec.datasets.lerobot.options import ExportOptions
from demorec.datasets.lerobot.verify import LEROBOT
from demorec.extensions.doctor.checks.lerobot_opens import lerobot_opens
from demorec.extensions.doctor.from_dataset import ReadOptions, evidence_of_dataset
from demorec.extensions.policies.policy import Policy

ROOT = Path(__file__).parents[2]
ABSENT = ("lerobot", "torch", "torchvision", "torchcodec", "datasets", "pandas", "huggingface_hub", "accelerate")


LEFT_OUT = {LEROBOT, "torch>=2.7", "huggingface-hub>=1.6,<2"}
"""LeRobot, and packages that only training, evaluation and uploading import."""


@pytest.fixture
def light(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hide these packages: importing them fails, and they cannot be found."""
    for name in ("lerobot", "datasets", "huggingface_hub", "accelerate"):  # tyro and pyarrow look for others
        monkeypatch.setitem(sys.modules, name, None)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run(tmp_path_factory.mktemp("light") / "run", (6, 5))


def test_the_lists_of_packages_agree() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    lines = (ROOT / "requirements-light.txt").read_text().splitlines()
    assert [line for line in lines if not line.startswith("#")] == [
        name for name in project["dependencies"] if name not in LEFT_OUT
    ]
    assert set(project["dependencies"]) >= LEFT_OUT


@pytest.mark.usefixtures("light")
def test_an_export_reports_that_nothing_was_verified(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert exit_code("export", "lerobot", run, "--out", tmp_path / "d") == 0
    out = capsys.readouterr().out
    assert f"Not verified: LeRobot, which verifies the dataset, is not installed: pip install '{LEROBOT}'." in out
    assert "Verified:" not in out


@pytest.mark.usefixtures("light")
def test_commands_that_need_lerobot_name_it(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dataset = tmp_path / "d"
    export_lerobot([run], dataset, ExportOptions(verify=False))
    evidence = evidence_of_dataset(dataset, ReadOptions(images=False, lerobot=True))
    result = lerobot_opens.run(evidence)
    assert result is not None
    assert (result.findings, "needs the package 'lerobot'" in result.not_measured) == ((), True)
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(MissingDependencyError, match="train"):
        Policy(tmp_path)
    with pytest.raises(MissingDependencyError, match="huggingface_hub") as error:
        push_to_hub(dataset, "me/cubes", private=True)
    assert str(dataset) in str(error.value)
    assert not isinstance(error.value, ExportError)


@pytest.mark.slow
def test_no_module_needs_them() -> None:
    """Every module of the package imports without them, in a new process."""
    code = f"""
import importlib, pkgutil, sys
sys.modules.update(dict.fromkeys({ABSENT!r}))
import demorec
for module in pkgutil.walk_packages(demorec.__path__, "demorec."):
    if module.name != "demorec.extensions.ray.on_ray":
        importlib.import_module(module.name)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    assert "evaluate" in COMMANDS.names()


def test_a_missing_package_is_named_with_its_install_command(run: Path, tmp_path: Path) -> None:
    blocked = "import sys; sys.modules['rerun'] = None; from demorec.cli import main; main(sys.argv[1:])"
    words = ["view", str(run), "--save", str(tmp_path / "new.rrd")]
    ended = subprocess.run([sys.executable, "-c", blocked, *words], capture_output=True, text=True, check=False)
    assert ended.returncode == MissingDependencyError("", "", "").exit_code
    sentence = "This command needs the package 'rerun-sdk', which is not installed: pip install rerun-sdk."
    assert ended.stderr == f"demorec view: {sentence}\n"

"""The programs of examples/recorder run, and their recordings match their loops."""

from __future__ import annotations

import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from support.commands import exit_code

from demorec.check.report import CheckOptions, check_subjects, find_subjects
from demorec.mcap import Recording
from demorec.runs.run_file import load_any_run_file

pytestmark = pytest.mark.slow  # loops in real time, and three programs that load PyBullet and gymnasium
EXAMPLES = Path(__file__).parents[2] / "examples" / "recorder"


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the run of each example."""
    folder = tmp_path_factory.mktemp("examples")
    programs = [
        subprocess.Popen(
            [sys.executable, str(EXAMPLES / f"{name}.py"), str(folder / name)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for name in ("real_robot", "own_simulation", "gym_wrapper")
    ]
    for program in programs:
        out, err = program.communicate(timeout=120)
        assert program.returncode == 0, err
        assert str(folder) in out
    return folder


def first_of(run: Path) -> Recording:
    return Recording(run / "episodes" / "episode_000000.mcap")


def test_a_robots_loop(runs: Path) -> None:
    assert [line.success for line in load_any_run_file(runs / "real_robot").attempts] == [True, True]
    with first_of(runs / "real_robot") as recording:
        table = recording.table()
    targets = np.sin(np.arange(60) / 10)
    assert table.features["action"].tolist() == [[target] * 6 for target in targets.tolist()]
    position = 0.0
    for row, target in zip(table.features["observation.state"], targets.tolist(), strict=True):
        assert row.tolist() == [position] * 6
        position += 0.5 * (target - position)
    held = table.images["top"]
    assert [int(number) for number in held] == [-1 if step % 3 == 2 else step - step // 3 for step in range(60)]
    assert (table.image_age_ns("top") >= 0).all()  # captured before the frame was written


def test_a_custom_simulation(runs: Path) -> None:
    with first_of(runs / "own_simulation") as recording:
        table = recording.table()
        state, action = recording.info.features
        assert state.joints == action.joints == tuple(f"lbr_iiwa_joint_{n}" for n in range(1, 8))
        assert "lbr_iiwa_link_7" in recording.info.urdf
        assert recording.info.cameras[0].intrinsics is not None
        assert math.isclose(recording.info.cameras[0].intrinsics[0], 64 / math.tan(math.pi / 6))
        front, side = (next(recording.images(name)) for name in ("front", "side"))
    assert table.time_ns.tolist() == [frame * 1_000_000_000 // 30 for frame in range(45)]
    last, goal = table.features["observation.state"][-1], table.features["action"][0]
    assert np.abs(last - goal).max() < np.abs(table.features["observation.state"][0] - goal).max()
    assert exit_code("check", str(runs / "own_simulation"), "--strict") == 0
    assert front.std() > 5
    assert np.abs(front.astype(int) - side).mean() > 1


def test_a_gymnasium_environment(runs: Path) -> None:
    lines = load_any_run_file(runs / "gym_wrapper").attempts
    assert [line.num_frames for line in lines] == [40, 40, 40]
    with first_of(runs / "gym_wrapper") as recording:
        table = recording.table()
    state = table.features["observation.state"]  # cosine, sine, angular velocity
    assert state.dtype == np.float32
    assert np.allclose(state[:, 0] ** 2 + state[:, 1] ** 2, 1, atol=1e-6)


def test_the_first_example_of_the_docs_passes_the_checks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = (Path(__file__).parents[2] / "docs" / "recorder.md").read_text()
    snippet = page.partition("```python\n")[2].partition("```")[0]
    monkeypatch.chdir(tmp_path)
    exec(compile(snippet, "recorder.md", "exec"), {})
    reports = check_subjects(find_subjects([tmp_path / "runs" / "first"]), CheckOptions(workers=1))
    odd = {result.check for report in reports for result in report.results if result.verdict in ("look", "broken")}
    assert odd <= {"rate"}  # a busy machine is slower

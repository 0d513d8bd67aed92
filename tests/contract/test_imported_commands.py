"""Every command of docs/README.md on an imported run and its dataset: it works, or says in a sentence why it cannot."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from support import bag_mappings, bags
from support.export import export, without_verification

from demorec.cli import main
from demorec.sources.import_run import import_bags

EXTERNAL = "recorded by another robot or program"
ROWS: dict[str, tuple[int, str]] = {
    "view RUN --save NEW.rrd": (0, "kB: "),
    "view DATASET --save NEW.rrd": (0, "kB: "),
    "check RUN": (0, "2 checked, 0 failed, 0 with warnings."),
    "check DATASET": (0, "1 checked, 0 failed, 0 with warnings."),
    "check RUN --deep": (1, EXTERNAL),
    "check DATASET --deep": (1, EXTERNAL),
    "report RUN --out NEW.html": (0, "1 episode"),
    "report DATASET --out NEW.html": (0, "1 episode"),
    "replay RECORDING": (1, EXTERNAL),
    "replay DATASET": (2, EXTERNAL),
    "render RECORDING --out NEW": (1, EXTERNAL),
    "dataset select DATASET --episodes 0 --out NEW": (0, "1 of 1 episode, 24 of 24 frames"),
    "export lerobot RUN --out NEW": (0, "1 episode, 24 frames"),
    "export hdf5 RUN --out NEW.hdf5": (0, "1 episode, 24 frames"),
    "evaluate --policy RUN": (2, "No policy"),
    "correct --policy RUN": (2, "No policy"),
    "generate --config RUN --out NEW": (2, EXTERNAL),
    "generate --config DATASET --out NEW": (2, EXTERNAL),
    "generate --config RECORDING --out NEW": (2, EXTERNAL),
    "import BAG --mapping MAPPING --out RUN": (0, "1 of 1 bags had been imported before."),
    "recover RECORDING --out NEW.mcap": (0, "Complete: all 24 frames"),
    "info RUN": (0, "unknown  24 "),
    "info RECORDING": (0, "/frames "),
    "info DATASET": (0, "observation.state"),
}
"""Command -> exit code, and words of what it says."""


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Upper-case word of a row -> path."""
    folder = tmp_path_factory.mktemp("imported")
    bag = bags.write_trossen(bags.in_order(bags.trossen(0.8)), folder / "bag.mcap")
    mapping = bag_mappings.write_mapping(bag_mappings.TROSSEN, folder / "robot.toml")
    import_bags([bag], mapping, folder / "run")
    export(folder / "run", folder / "dataset")
    recording = folder / "run" / "episodes" / "episode_000000.mcap"
    return {
        "BAG": bag,
        "MAPPING": mapping,
        "RUN": folder / "run",
        "RECORDING": recording,
        "DATASET": folder / "dataset",
    }


def test_every_documented_command_has_a_row() -> None:
    readme = (Path(__file__).parents[2] / "docs" / "README.md").read_text()
    block = readme.partition("## Commands\n")[2].partition("Every command has `--help`")[0]
    commands = set(re.findall(r"^    demorec (\S+)", block, flags=re.MULTILINE))
    assert commands - {row.split()[0] for row in ROWS} == {"list"}  # which takes no path


@pytest.mark.parametrize("row", ROWS)
def test_it_works_or_says_why_not(
    row: str,
    places: dict[str, Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    without_verification(monkeypatch)
    words = {name: str(path) for name, path in places.items()} | {"NEW": str(tmp_path / "new")}
    args = [re.sub(r"\b[A-Z]{3,}\b", lambda found: words[found[0]], word) for word in row.split()]
    with pytest.raises(SystemExit) as ended:
        main(args)
    code, told = ROWS[row]
    printed = capsys.readouterr()
    assert (ended.value.code, told in printed.out + printed.err) == (code, True), printed
    assert "Traceback" not in printed.err
    if code == 2:
        (sentence,) = printed.err.strip().splitlines()
        assert sentence.startswith(f"demorec {args[0]}: ")
        assert not list(tmp_path.iterdir())

"""After an interrupted import every command lists the missing episodes, and the same import command continues it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from support import bag_mappings, bags
from support.commands import exit_code
from support.export import export, make_run

from demorec.extensions.recorder.sampled_writer import SampledWriter

pytestmark = pytest.mark.slow

BAGS = ("monday.mcap", "tuesday.mcap", "wednesday.mcap")
EPISODES = ("episode 0", "episode 1", "episode 2")


@pytest.fixture(scope="module")
def calls(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[list[object], tuple[str, ...]]]:
    """Kind of import -> its command without --out, and its planned sources, each of one episode."""
    folder = tmp_path_factory.mktemp("sources")
    run = make_run(folder / "run", (4, 5, 6), cameras=("front",))
    export(run, folder / "dataset")
    assert exit_code("export", "hdf5", run, "--out", folder / "demo.hdf5") == 0
    for number, name in enumerate(BAGS):
        bags.write_mcap(bags.in_order(bags.so101(0.5 + 0.1 * number)), folder / name)
    mapping = bag_mappings.write_mapping(bag_mappings.SO101, folder / "robot.toml")
    return {
        "lerobot": (["lerobot", folder / "dataset"], EPISODES),
        "hdf5": (["hdf5", folder / "demo.hdf5", "--mapping", folder / "hdf5.toml"], EPISODES),
        "bags": ([*(folder / name for name in BAGS), "--mapping", mapping], BAGS),
    }


def info(run: Path, capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    capsys.readouterr()
    assert exit_code("info", run, "--json") == 0
    plain: dict[str, Any] = json.loads(capsys.readouterr().out)
    return plain


@pytest.mark.parametrize(("kind", "num_done"), [("lerobot", 1), ("hdf5", 2), ("bags", 0), ("bags", 1)])
def test_an_interrupted_import_lists_missing_episodes(
    kind: str,
    num_done: int,
    calls: dict[str, tuple[list[object], tuple[str, ...]]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    words, planned = calls[kind]
    if kind == "hdf5":
        assert exit_code("import", "hdf5", words[1], "--suggest") == 0
        Path(str(words[3])).write_text(capsys.readouterr().out)
    run, undisturbed = tmp_path / "run", tmp_path / "undisturbed"
    finished: list[Path] = []
    finish = SampledWriter.finish

    def interrupted(self: SampledWriter, *arguments: Any) -> Any:
        if len(finished) == num_done:
            raise KeyboardInterrupt
        finished.append(run)
        return finish(self, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(SampledWriter, "finish", interrupted)
        assert exit_code("import", *words, "--out", run) == 130
    if num_done:
        missing = planned[num_done:]
        plain = info(run, capsys)
        assert (plain["complete"], plain["planned"], len(plain["episodes"])) == (False, list(missing), num_done)
        sentence = f"The run is unfinished, {', '.join(missing)} {'is' if len(missing) == 1 else 'are'} not imported"
        for command in ("info", "check --no-images", "check --no-images --strict", f"export hdf5 --out {tmp_path}/new"):
            told = exit_code(*command.split(), run, *(["--overwrite"] if "export" in command else []))
            assert told == (1 if "--strict" in command else 0), command
            both = capsys.readouterr()
            assert sentence in both.out + both.err, command
    else:
        assert not run.exists(), "nothing was imported, and nothing is left"
    assert exit_code("import", *words, "--out", run) == 0
    assert exit_code("import", *words, "--out", undisturbed) == 0
    plain, other = info(run, capsys), info(undisturbed, capsys)
    assert (plain["complete"], plain["planned"]) == (True, [])
    assert plain["digest"] == other["digest"]
    assert plain["episodes"] == other["episodes"]
    assert exit_code("check", run, "--no-images", "--strict", "--only", "run_complete") == 0

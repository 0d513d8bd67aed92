"""The dataset card: what it says, whose it is, and that nothing foreign acts in it."""

from __future__ import annotations

import json
from pathlib import Path

import pyarrow.parquet as pq
from support.export import export, make_run
from support.mcap import rewritten
from support.recording import write_episode

from demorec.mcap import Recording


def test_a_card_names_the_command_that_makes_the_dataset_again(tmp_path: Path) -> None:
    command = "generate-dataset --config path/of/this/folder --out copy"
    run = make_run(tmp_path / "run", (6, 5, 7), cameras=())
    export(run, tmp_path / "d", episodes="0:2", repo_id="me/cubes")
    assert command in (tmp_path / "d" / "README.md").read_text()
    export(run, tmp_path / "d", episodes="2", repo_id="me/cubes", append=True)
    assert command not in (tmp_path / "d" / "README.md").read_text()


def test_an_edited_card_stays_when_the_dataset_is_replaced(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", (6, 5), cameras=())
    card, beside = tmp_path / "d" / "README.md", tmp_path / "d" / "demorec" / "README.md"
    export(run, tmp_path / "d")
    export(run, tmp_path / "d", episodes="0", overwrite=True)
    assert "1 scripted demonstration by" in card.read_text()  # nobody has edited it, so it is replaced
    assert not beside.exists()
    card.write_text("what I found out about these")
    export(run, tmp_path / "d", overwrite=True)
    assert card.read_text() == "what I found out about these"
    assert "2 scripted demonstrations" in beside.read_text()


def test_nothing_foreign_acts_in_a_card(tmp_path: Path) -> None:
    """Markdown's own words, HTML and what a terminal obeys, in the texts of a recording that somebody passed on."""
    hostile = "# <script>alert(1)</script> ![x](http://e.org) | `y` *z* \x1b[2J \u202e"
    good = write_episode(tmp_path / "good.mcap", num_frames=6, cameras=())
    with Recording(good) as recording:
        info = json.loads(recording._container.metadata("demorec.episode")["info"])  # type: ignore[index]
    info["instruction"] = hostile
    info["simulation"]["config"]["renderer"] = hostile
    (tmp_path / "bad.mcap").write_bytes(rewritten(good, change={"demorec.episode": {"info": json.dumps(info)}}))
    export(tmp_path / "bad.mcap", tmp_path / "d")
    card = (tmp_path / "d" / "README.md").read_text()
    for acting in ("<script", "\x1b", "\u202e", "![x]", "*z*", "`y`"):
        assert acting not in card
    assert r"- \# &lt;script&gt;alert(1)&lt;/script&gt;" in card
    assert pq.read_table(tmp_path / "d/meta/tasks.parquet").column("task").to_pylist() == [hostile]

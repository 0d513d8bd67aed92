"""The dataset card: its content, its ownership, and that third-party text in it has no effect."""

from __future__ import annotations

import json
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from support import bag_mappings, bags
from support.commands import exit_code
from support.export import export, make_run
from support.external import TOP, make_external, write_external
from support.mcap import rewritten
from support.recording import write_episode

from demorec.extensions.imports import import_run
from demorec.mcap import Recording


def test_an_edited_card_stays_when_the_dataset_is_replaced(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", (6, 5), cameras=())
    card = tmp_path / "d" / "README.md"
    export(run, tmp_path / "d")
    export(run, tmp_path / "d", episodes="0", overwrite=True)
    assert "1 scripted demonstration by" in card.read_text()  # an unedited card is replaced
    card.write_text("what I found out about these")
    export(run, tmp_path / "d", overwrite=True)
    assert card.read_text() == "what I found out about these"
    export(make_run(tmp_path / "more", (7,), seed=1, cameras=()), tmp_path / "d", append=True)
    assert card.read_text() == "what I found out about these"


def test_foreign_text_has_no_effect_in_a_card(tmp_path: Path) -> None:
    """Markdown syntax, HTML and terminal control codes in the texts of a third-party recording."""
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


@pytest.mark.parametrize("kind", ["bag", "recorder"])
def test_a_card_and_info_claim_nothing_of_imported_data(
    kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if kind == "bag":
        bag = bags.write_mcap(bags.in_order(bags.so101(1.6)), tmp_path / "stack.mcap")
        derived = bag_mappings.SO101.replace(
            'topic = "/leader/joint_states"\nfield = "position"', 'next = "observation.state"'
        )
        mapping = bag_mappings.write_mapping(derived, tmp_path / "m.toml")
        import_run.import_bags([bag], mapping, tmp_path / "run")
    else:
        write_external(tmp_path / "run.mcap", make_external(cameras=(TOP,)))
    (source,) = tmp_path.glob("run*")
    export(source, tmp_path / "d")
    card = (tmp_path / "d" / "README.md").read_text()
    for claim in (
        "license:",
        "ecorded and exported by demorec",
        "stored as recorded",
    ):
        assert claim not in card
    assert kind == "recorder" or "| `action` | float32 | [6] | observation.state of the next frame |" in card
    assert exit_code("info", tmp_path / "d") == 0
    assert ("successes" in capsys.readouterr().out) == (kind == "recorder")  # a bag has no outcome
    export(source, tmp_path / "licensed", license="cc-by-4.0")
    assert "license: cc-by-4.0" in (tmp_path / "licensed" / "README.md").read_text()

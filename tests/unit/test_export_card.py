"""The dataset card: commands that can be typed, thumbnails that say what they show."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from PIL import Image
from support.export import export, make_run
from support.mcap import rewritten
from support.recording import frame_number, write_episode

from demorec.cli.export import Export
from demorec.cli.generate import Generate
from demorec.cli.shared.flags import parse
from demorec.core.config import GenerateConfig, VideoConfig
from demorec.datasets.lerobot.card import flags
from demorec.datasets.lerobot.options import ExportOptions
from demorec.episode.variation import Ranges
from demorec.mcap import Recording


def commands_of(dataset: Path) -> list[str]:
    lines = (dataset / "README.md").read_text().splitlines()
    start = lines.index("Made by these commands:") + 3
    return lines[start : lines.index("```", start)]


@pytest.mark.parametrize(
    "config",
    [
        GenerateConfig(),
        GenerateConfig(task="stack", robot="iiwa", seed=7, cameras=(), antialias=False, depth=True, split="train"),
        GenerateConfig(
            task="my_package.tasks:Mine",
            cameras=("wrist",),
            video=VideoConfig(codec="av1", crf=40, gop=10),
            variation="full",
            ranges=Ranges(cube_mass=(0.02, 0.5), distractors=(0, 3), joint_spread=0.1),
        ),
    ],
)
def test_the_flags_of_a_config_are_parsed_to_it(config: GenerateConfig) -> None:
    words = shlex.split(" ".join(flags(config, GenerateConfig())))
    assert parse(Generate, words, prog="generate-dataset").episodes == config


def test_the_commands_of_a_card_make_the_dataset(tmp_path: Path) -> None:
    options: dict[str, Any] = {
        "repo_id": "me/cubes",
        "action": "ee",
        "privileged": True,
        "episodes": "0:2",
        "license": "it's mine",
    }
    export(make_run(tmp_path / "run", (6, 5, 7)), tmp_path / "d", **options)
    generating, exporting = (shlex.split(command) for command in commands_of(tmp_path / "d"))
    assert generating[0] == "generate-dataset"
    made = parse(Generate, generating[1:], prog="")
    assert made.episodes == GenerateConfig(task="pick_place", seed=0, video=VideoConfig(codec="h264"))
    assert (made.options.num_episodes, made.options.export) == (2, False)
    assert exporting[:2] == ["demorec", "export"]
    parsed = parse(Export, exporting[2:], prog="")
    assert parsed.options == ExportOptions(**options)
    assert parsed.sources == (made.options.out,)
    assert "generate-dataset --config path/of/this/folder --out copy" in (tmp_path / "d" / "README.md").read_text()


@pytest.mark.parametrize("language", [None, (), ("subtask", "plan")])
def test_the_flags_of_an_export_are_parsed_to_it(language: tuple[str, ...] | None) -> None:
    options = ExportOptions(repo_id="me/cubes", language=language, progress=True)
    words = ["run", "--repo-id", "me/cubes", *shlex.split(" ".join(flags(options, ExportOptions(repo_id="me/cubes"))))]
    parsed = parse(Export, ["lerobot", *words, "--out", "d"], prog="")
    assert parsed.options == options


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


def test_thumbnails_are_labelled(tmp_path: Path) -> None:
    export(make_run(tmp_path / "run", (31, 16)), tmp_path / "d")
    sheet = np.asarray(Image.open(tmp_path / "d" / "demorec" / "thumbnails.jpg")).astype(int)
    assert sheet.shape == (2 * (18 + 120), 5 * 160 + 4 * 2, 3)
    labels = [sheet[row * 138 : row * 138 + 18] for row in range(2)]
    for label in labels:
        assert label.max() > 240  # black on white
        assert label.min() < 60
    assert np.abs(labels[0] - labels[1]).max() > 100  # of another episode
    small = [
        sheet[18 + 138 * row : 138 * (row + 1), 162 * column : 162 * column + 160]
        for row in (0, 1)
        for column in range(5)
    ]
    assert [frame_number(np.asarray(Image.fromarray(p.astype(np.uint8)).resize((64, 48)))) for p in small[:5]] == [
        0,
        8,
        15,
        22,
        30,
    ]


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

"""Bounding boxes in datasets match the segmentation images; playback shows the words of a dataset."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from support.check import simulate_run
from support.export import export, make_run
from support.language import NOUNS, language_of

from demorec.core.errors import ConfigError
from demorec.extensions.datasets.folder import LeRobotFolder
from demorec.extensions.datasets.inspect import dataset_digest
from demorec.mcap import Recording

PREFIX = "observation.images."


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate_run(
        tmp_path_factory.mktemp("run") / "clutter", 1, task="pick_from_clutter", seed=5, cameras=("front", "wrist"),
        width=128, height=128, segmentation=True,
    )  # fmt: skip


@pytest.fixture(scope="module")
def dataset(run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("dataset") / "d"
    report = export(run, out, language=(), boxes=True)
    assert report.digest == dataset_digest(out)
    return out


def test_a_thousand_boxes_are_those_of_the_segmentation(run: Path, dataset: Path) -> None:
    (path,) = (run / "episodes").glob("*.mcap")
    count = 0
    with Recording(path) as recording:
        label_of = {name: label for label, name in recording.segment_names().items()}
        spoken = [body for body in recording.info.simulated.scene.bodies if body.role not in ("fixture", "support")]
        for camera in recording.cameras:
            images = list(recording.segmentation(camera))
            stored = json.loads((dataset / "demorec" / "boxes" / f"{PREFIX}{camera}.json").read_text())
            nouns = {category["id"]: category["name"] for category in stored["categories"]}
            assert [image["id"] for image in stored["images"]] == list(range(len(images)))
            boxes = {(item["image_id"], item["object"]): item for item in stored["annotations"]}
            assert len(boxes) == len(stored["annotations"])
            for frame, image in enumerate(images):
                for body in spoken:
                    shown = image == label_of[body.name]
                    item = boxes.pop((frame, body.name), None)
                    assert (item is not None) == bool(shown.any())
                    if item is None:
                        continue
                    rows, columns = np.nonzero(shown)
                    x, y = columns.min(), rows.min()
                    assert item["bbox"] == [x, y, columns.max() + 1 - x, rows.max() + 1 - y]
                    assert item["area"] == shown.sum()
                    assert NOUNS[nouns[item["category_id"]]](body)
                    assert item["color"] == body.color_name
                    count += 1
            assert boxes == {}
    assert count > 1000


def test_boxes_need_segmentation_and_a_whole_dataset(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", [8])
    export(run, tmp_path / "told", language=())
    with pytest.raises(ConfigError, match="need recordings with segmentation"):
        export(run, tmp_path / "boxed", boxes=True)
    with pytest.raises(ConfigError, match="--boxes is written for a whole dataset"):
        export(run, tmp_path / "told", boxes=True, append=True)


def test_playback_has_the_words(dataset: Path, tmp_path: Path) -> None:
    from rerun.chunk import RrdReader

    from demorec.extensions.datasets.playback import open_dataset_episode
    from demorec.view.scene import save
    from demorec.view.sources import find_episodes

    (frames,) = language_of(dataset)
    subtasks = {row["timestamp"]: row["content"] for row in frames[0][0] if row["style"] == "subtask"}
    with open_dataset_episode(LeRobotFolder(dataset), 0) as episode:
        assert episode.info.simulation is not None
        shown = {frame: text for frame, kind, text in episode.statements if kind == "subtask"}
        assert [frame / episode.info.fps for frame in shown] == pytest.approx(list(subtasks), abs=1e-3)
        assert list(shown.values()) == list(subtasks.values())
    save(find_episodes([dataset])[0], tmp_path / "x.rrd")
    pages: list[str] = []
    for chunk in RrdReader(tmp_path / "x.rrd").stream():
        batch = chunk.to_record_batch()
        if chunk.entity_path == "/words":
            pages += [page[0] for page in batch.column("TextDocument:text").to_pylist()]
    assert len(pages) == len(subtasks)
    assert all(text in page for text, page in zip(subtasks.values(), pages, strict=True))
    assert pages[-1].endswith("on the green target.")

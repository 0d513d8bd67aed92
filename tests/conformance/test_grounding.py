"""Questions, traces and boxes against images of segmentation, projection and the scene, each computed anew."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.check import simulate_run
from support.export import export, make_run
from support.language import NOUNS, language_of, meant, phrases

from demorec.core.errors import ConfigError
from demorec.core.geometry import rotation_from_quat
from demorec.datasets.episode import ExportEpisode
from demorec.datasets.lerobot import ExportOptions, dataset_digest
from demorec.datasets.lerobot.prepare import prepare_episode
from demorec.mcap import Recording

PREFIX = "observation.images."
Row = dict[str, Any]


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


class Truth:
    """The recording, and images of segmentation by the names of the bodies."""

    def __init__(self, run: Path) -> None:
        (path,) = (run / "episodes").glob("*.mcap")
        self.recording = Recording(path)
        self.columns, self.scene = self.recording.columns(), self.recording.info.scene
        names = self.recording.segment_names()
        self.labels = {camera: list(self.recording.segmentation(camera)) for camera in self.recording.cameras}
        self.number = {name: value for value, name in names.items()}

    def mask(self, camera: str, frame: int, body: str) -> NDArray[np.bool_]:
        return np.asarray(self.labels[camera][frame] == self.number[body])

    def pixel(self, camera: str, frame: int, point: NDArray[np.float64]) -> NDArray[np.float64]:
        """(2,) px: X_camera = R^T (X - t), then K; beyond all images for a point behind the camera."""
        intrinsics = next(item for item in self.scene.cameras if item.name == camera).intrinsics
        pose = self.columns.world_from_camera[camera][frame]
        x, y, z = rotation_from_quat(pose[3:]).T @ (point - pose[:3])
        if z <= 0:
            return np.full(2, -np.inf)
        return np.array([intrinsics[0, 0] * x / z + intrinsics[0, 2], intrinsics[1, 1] * y / z + intrinsics[1, 2]])

    def position(self, frame: int, body: str) -> NDArray[np.float64]:
        poses = self.columns.object_poses.get(body)
        return self.scene.body(body).world_from_body.position if poses is None else np.asarray(poses[frame, :3])

    def meant(self, phrase: str, frame: int) -> str:
        """The one body that a phrase means at that moment."""
        from dataclasses import replace

        from demorec.core.geometry import Pose

        moved = [
            replace(body, world_from_body=Pose(position=self.position(frame, body.name))) for body in self.scene.bodies
        ]
        (found,) = phrases(phrase)
        (name,) = meant(found, replace(self.scene, bodies=tuple(moved)))
        return name


@pytest.fixture(scope="module")
def truth(run: Path) -> Truth:
    return Truth(run)


def answers(dataset: Path, style: str) -> list[tuple[int, str, str, Row]]:
    """(frame, camera, question, answer) of every event of a style."""
    found = []
    (frames,) = language_of(dataset)
    for frame, (_, events) in enumerate(frames):
        for camera in ("front", "wrist"):
            rows = [row for row in events if row["style"] == style and row["camera"] == PREFIX + camera]
            asked = [row["content"] for row in rows if row["role"] == "user"]
            told = [json.loads(row["content"]) for row in rows if row["role"] == "assistant"]
            assert len(told) <= 1
            assert len(asked) == (len(told) if style == "vqa" else 0)
            found += [(frame, camera, asked[0] if asked else "", answer) for answer in told]
    return found


@pytest.mark.slow
def test_lerobots_validator_knows_every_question(dataset: Path, tmp_path: Path) -> None:
    from lerobot.annotations.steerable_pipeline.reader import iter_episodes
    from lerobot.annotations.steerable_pipeline.staging import EpisodeStaging
    from lerobot.annotations.steerable_pipeline.validator import StagingValidator, classify_vqa_answer

    records = list(iter_episodes(dataset))
    (frames,) = language_of(dataset)
    times = records[0].frame_timestamps
    staging = EpisodeStaging(tmp_path, 0)
    staging.write("plan", frames[0][0])
    events = [{**row, "timestamp": times[frame]} for frame, (_, rows) in enumerate(frames) for row in rows]
    staging.write("vqa", events)
    report = StagingValidator(dataset_camera_keys=(PREFIX + "front", PREFIX + "wrist")).validate(records, tmp_path)
    assert (report.errors, report.warnings) == ([], [])
    kinds = {classify_vqa_answer(answer) for _, _, _, answer in answers(dataset, "vqa")}
    assert kinds == {"bbox", "keypoint", "count", "attribute", "spatial"}


def test_answers_are_true(dataset: Path, truth: Truth) -> None:
    found = answers(dataset, "vqa")
    assert len(found) >= 12
    for frame, camera, question, answer in found:
        if "detections" in answer:
            (thing,) = answer["detections"]
            mask = truth.mask(camera, frame, truth.meant(thing["label"], frame))
            rows, columns = np.nonzero(mask)
            assert thing["bbox"] == [columns.min(), rows.min(), columns.max(), rows.max()]
            assert thing["label"] in question
        elif "point" in answer:
            name = truth.meant(answer["label"], frame)
            expected = truth.pixel(camera, frame, truth.position(frame, name))
            assert np.abs(np.array(answer["point"]) + 0.5 - expected).max() <= 0.5
            assert truth.mask(camera, frame, name)[answer["point"][1], answer["point"][0]]
        elif "count" in answer:
            fitting = [
                body.name for body in truth.scene.bodies if NOUNS[answer["label"]](body) and body.role != "fixture"
            ]
            assert answer["count"] == sum(bool(truth.mask(camera, frame, name).any()) for name in fitting)
        elif "attribute" in answer:
            assert truth.scene.body(truth.meant(answer["label"], frame)).color_name == answer["value"]
            assert answer["value"] not in question
        else:
            subject, other = (truth.meant(answer[part], frame) for part in ("subject", "object"))
            assert truth.mask(camera, frame, subject).any()
            x, u = (truth.pixel(camera, frame, truth.position(frame, name))[0] for name in (subject, other))
            offset = truth.position(frame, subject) - truth.position(frame, other)
            is_on = np.abs(offset[:2]).max() < 0.04 and 0 < offset[2] < 0.04
            assert answer["relation"] == ("on" if is_on else "left_of" if x < u else "right_of")
            assert is_on or abs(x - u) > 0.05 * 128


def test_a_image_alone_is_asked_the_same(run: Path, dataset: Path) -> None:
    """What is prepared of two rows, as the verification does it, is what the dataset has there."""
    (frames,) = language_of(dataset)
    (path,) = (run / "episodes").glob("*.mcap")
    step, last = 30, len(frames) - 1
    with Recording(path) as recording:
        options = ExportOptions(language=())
        told = prepare_episode(
            ExportEpisode(recording, options), options, encode_depth=False, about=[2 * step, last]
        ).language
    there = {row: events for row, (_, events) in enumerate(frames) if events}
    assert len(there) > 3
    assert {row: list(entries) for row, entries in told.events.items()} == {
        row: there[row] for row in (2 * step, last) if row in there
    }
    assert list(told.persistent) == frames[0][0]


def test_traces_are_where_the_tcp_will_be(dataset: Path, truth: Truth) -> None:
    found = answers(dataset, "trace")
    last = truth.columns.num_frames - 1
    assert {camera for _, camera, _, _ in found} == {"front", "wrist"}
    for frame, camera, _, answer in found:
        expected = []
        for step in range(6):
            later = min(frame + 6 * step, last)
            tcp = truth.scene.robot.world_from_base.apply(truth.columns.base_from_tcp[later, :3])
            expected.append(truth.pixel(camera, frame, tcp))
        inside = [bool(((point >= 0) & (point < 128)).all()) for point in expected]
        length = inside.index(False) if False in inside else 6
        assert len(answer["points"]) == length
        assert np.abs(np.array(answer["points"]) + 0.5 - np.array(expected[:length])).max() <= 0.5


@pytest.mark.filterwarnings("ignore:__array__ implementation")
def test_a_thousand_boxes_are_those_of_the_segmentation(dataset: Path, truth: Truth) -> None:
    masks = pytest.importorskip("pycocotools.mask")
    count = 0
    for camera in ("front", "wrist"):
        told = json.loads((dataset / "demorec" / "boxes" / f"{PREFIX}{camera}.json").read_text())
        nouns = {category["id"]: category["name"] for category in told["categories"]}
        assert [image["id"] for image in told["images"]] == list(range(truth.columns.num_frames))
        seen = {(item["image_id"], item["object"]): item for item in told["annotations"]}
        assert len(seen) == len(told["annotations"])
        spoken = [body for body in truth.scene.bodies if body.role not in ("fixture", "support")]
        for frame in range(truth.columns.num_frames):
            for body in spoken:
                mask = truth.mask(camera, frame, body.name)
                item = seen.pop((frame, body.name), None)
                assert (item is not None) == bool(mask.any())
                if item is None:
                    continue
                rows, columns = np.nonzero(mask)
                x, y = columns.min(), rows.min()
                assert item["bbox"] == [x, y, columns.max() + 1 - x, rows.max() + 1 - y]
                assert item["area"] == mask.sum()
                stored = {"size": [128, 128], "counts": item["segmentation"]["counts"]}
                assert np.array_equal(masks.decode(stored), mask)
                assert NOUNS[nouns[item["category_id"]]](body)
                assert item["color"] == body.color_name
                count += 1
        assert seen == {}
    assert count > 1000


@pytest.mark.filterwarnings("ignore:__array__ implementation")
def test_pycocotools_reads_them(dataset: Path) -> None:
    coco = pytest.importorskip("pycocotools.coco")
    masks = pytest.importorskip("pycocotools.mask")
    for camera in ("front", "wrist"):
        found = coco.COCO(dataset / "demorec" / "boxes" / f"{PREFIX}{camera}.json")
        for item in found.dataset["annotations"]:
            assert found.annToMask(item).sum() == item["area"]
            assert masks.toBbox(found.annToRLE(item)).tolist() == item["bbox"]


def test_without_segmentation_there_are_traces_and_no_questions(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", [8])
    export(run, tmp_path / "told", language=())
    (frames,) = language_of(tmp_path / "told")
    assert {row["style"] for _, rows in frames for row in rows} <= {"trace"}
    with pytest.raises(ConfigError, match="need recordings with segmentation"):
        export(run, tmp_path / "asked", language=("vqa",))
    with pytest.raises(ConfigError, match="need recordings with segmentation"):
        export(run, tmp_path / "boxed", boxes=True)
    with pytest.raises(ConfigError, match="--boxes are written for a whole dataset"):
        export(run, tmp_path / "told", boxes=True, append=True)


def test_playback_has_the_words_and_the_boxes(dataset: Path, tmp_path: Path) -> None:
    from rerun.chunk import RrdReader

    from demorec.view.from_dataset import open_dataset_episode
    from demorec.view.save import save
    from demorec.view.sources import find_episodes

    (frames,) = language_of(dataset)
    subtasks = {row["timestamp"]: row["content"] for row in frames[0][0] if row["style"] == "subtask"}
    with open_dataset_episode(dataset, 0) as episode:
        assert episode.info.simulation is not None
        shown = {time_ns: text for time_ns, kind, text in episode.statements if kind == "subtask"}
        assert [round(time_ns / 1e9, 3) for time_ns in shown] == [round(time, 3) for time in subtasks]
        assert list(shown.values()) == list(subtasks.values())
        assert set(episode.boxes) == {"front", "wrist"}
    save(find_episodes([dataset])[0], tmp_path / "x.rrd")
    pages: list[str] = []
    counts: list[int] = []
    for chunk in RrdReader(tmp_path / "x.rrd").stream():
        batch = chunk.to_record_batch()
        if chunk.entity_path == "/words":
            pages += [page[0] for page in batch.column("TextDocument:text").to_pylist()]
        if chunk.entity_path == "/world/cameras/front/boxes" and not chunk.is_static:
            counts += [len(boxes or ()) for boxes in batch.column("Boxes2D:half_sizes").to_pylist()]
    assert len(pages) == len(subtasks)
    assert all(text in page for text, page in zip(subtasks.values(), pages, strict=True))
    assert pages[-1].endswith("on the green target.")
    told = json.loads((dataset / "demorec" / "boxes" / f"{PREFIX}front.json").read_text())
    assert counts == [sum(item["image_id"] == frame for item in told["annotations"]) for frame in range(len(frames))]

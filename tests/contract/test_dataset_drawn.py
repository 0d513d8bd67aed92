"""Videos of a dataset against its states, when there is no run beside it: late, exchanged and foreign images."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from support.check import checked, level_of, simulate_run
from support.export import rewrite_video

from demorec.check.base import Level
from demorec.check.dataset import Dataset
from demorec.datasets.lerobot.export import export_lerobot
from demorec.datasets.lerobot.options import ExportOptions

pytestmark = pytest.mark.slow

FRONT, WRIST = "observation.images.front", "observation.images.wrist"
CHECKS = ("dataset_images_as_drawn", "dataset_image_lag")
Images = list[Any]


@pytest.fixture(scope="module")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The dataset of two episodes, filmed by both cameras; the run's folder is not beside it."""
    folder = tmp_path_factory.mktemp("drawn")
    simulate_run(folder / "run", 2, seed=3, fps=10, cameras=("front", "wrist"), width=64, height=64)
    export_lerobot([folder / "run"], folder / "dataset", ExportOptions(verify=False))
    return folder / "dataset"


@pytest.fixture
def dataset(filmed: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(filmed, tmp_path / "dataset"))


def levels(dataset: Path) -> list[Level]:
    return [result.level for result in checked(dataset, "dataset", only=CHECKS).results]


def test_good_ones_pass(filmed: Path) -> None:
    assert levels(filmed) == ["pass", "pass"]


@pytest.mark.parametrize(("width", "height"), [(96, 72), (64, 80), (126, 94)])
def test_good_ones_pass_whatever_their_shape(width: int, height: int, tmp_path: Path) -> None:
    simulate_run(tmp_path / "run", 1, seed=3, fps=10, cameras=("wrist",), width=width, height=height)
    export_lerobot([tmp_path / "run"], tmp_path / "dataset", ExportOptions(verify=False))
    assert not {"warn", "fail"} & set(levels(tmp_path / "dataset"))
    assert ("pass" in levels(tmp_path / "dataset")) == (width != 126)  # 63 by 47 parts of two pixels are too many


def test_what_falls_first_is_not_drawn(tmp_path: Path) -> None:
    """The tutorial's cube starts in the air; a dataset does not say where it comes to lie."""
    simulate_run(tmp_path / "run", 1, task="tutorial", seed=3, fps=10, cameras=("wrist",), width=64, height=64)
    export_lerobot([tmp_path / "run"], tmp_path / "dataset", ExportOptions(verify=False))
    assert levels(tmp_path / "dataset") == ["skip", "skip"]


def test_a_dataset_of_somebody_else_has_nothing_to_compare_with(dataset: Path) -> None:
    shutil.rmtree(dataset / "demorec")
    assert levels(dataset) == ["skip", "skip"]


def late(start: int, end: int) -> Callable[[Images], Images]:
    """The images of one episode, one frame late."""
    return lambda images: [*images[:start], images[start], *images[start : end - 1], *images[end:]]


@pytest.mark.parametrize("key", [FRONT, WRIST])
@pytest.mark.parametrize("number", [0, 1])
def test_one_episode_one_frame_late(key: str, number: int, dataset: Path) -> None:
    place = Dataset(dataset).places[number]
    start = place.videos[key][1]
    rewrite_video(dataset, key, late(start, start + place.length))
    assert level_of(dataset, "dataset_image_lag", "dataset") == "fail"


def test_one_episode_one_frame_early(dataset: Path) -> None:
    length = Dataset(dataset).places[0].length
    rewrite_video(dataset, FRONT, lambda p: [*p[1:length], p[length - 1], *p[length:]])
    assert level_of(dataset, "dataset_image_lag", "dataset") == "fail"


def test_cameras_exchanged(dataset: Path) -> None:
    front, wrist = dataset / "videos" / FRONT, dataset / "videos" / WRIST
    front.rename(dataset / "videos" / "other")
    wrist.rename(front)
    (dataset / "videos" / "other").rename(wrist)
    assert level_of(dataset, "dataset_images_as_drawn", "dataset") == "fail"


@pytest.mark.parametrize("key", [FRONT, WRIST])
def test_videos_of_two_episodes_exchanged(key: str, dataset: Path) -> None:
    first, second = (place.length for place in Dataset(dataset).places)

    def exchanged(images: Images) -> Images:
        one, other = images[:first], images[first:]
        return [*(other + other[-1:] * first)[:first], *(one + one[-1:] * second)[:second]]

    rewrite_video(dataset, key, exchanged)
    assert "fail" in levels(dataset)


def test_mirrored_images_of_one_camera(dataset: Path) -> None:
    rewrite_video(dataset, FRONT, lambda images: [image[:, ::-1] for image in images])
    assert "fail" in levels(dataset)

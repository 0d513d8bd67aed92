"""The reader for training against LeRobot's own: the same items, bit for bit."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from lerobot_datasets import CAMERA, assert_same_item, write_by_lerobot

if TYPE_CHECKING:
    import torch

    from lerobot_policy_act_keypoints import FastDataset

LENGTHS = (7, 11, 5, 9)
KINDS = ("videos", "images", "long_gops")
"""All except the last have depth; LeRobot codes colours as AV1, those of the last as H.264 in long groups."""


def quick(*chosen: str) -> list[Any]:
    """Return all kinds, those not chosen marked as long tests: LeRobot's reader is slow."""
    return [kind if kind in chosen else pytest.param(kind, marks=pytest.mark.long) for kind in KINDS]


HISTORY = [-2 / 30, 0.0]
CHUNK = [k / 30 for k in range(16)]


pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def roots(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Map each kind to a dataset, made on demand."""
    return _Made(tmp_path_factory.mktemp("datasets"))


class _Made(dict[str, Path]):
    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def __missing__(self, kind: str) -> Path:
        from lerobot.configs import RGBEncoderConfig

        root = self[kind] = self._folder / kind
        long_gops = RGBEncoderConfig(vcodec="h264", g=12, extra_options={"bf": "2"})
        if kind == "images":
            write_by_lerobot(root, LENGTHS, stored_as="image", depth=True)
        elif kind == "long_gops":
            write_by_lerobot(root, LENGTHS, rgb_encoder=long_gops)
        else:
            write_by_lerobot(root, LENGTHS, depth=True)
        for folder in (root / "data", *(root / "videos").glob("*")):
            assert len(list(folder.rglob("file-*"))) > 1, folder
        return root


def pair(root: Path, **arguments: Any) -> tuple[FastDataset, Any]:
    """Make both readers with the same arguments."""
    from lerobot.datasets import LeRobotDataset

    from lerobot_policy_act_keypoints import FastDataset

    arguments = {"root": root, "video_backend": "pyav", "return_uint8": True, **arguments}
    return FastDataset("local/test", **arguments), LeRobotDataset("local/test", **arguments)


def windows(dataset: Any) -> dict[str, list[float]]:
    """Request two past observations and a chunk of actions, as policies do."""
    texts = {key for key, feature in dataset.meta.features.items() if feature["dtype"] == "string"}
    keys = [key for key in dataset.meta.features if key.startswith("observation.") and key not in texts]
    return {**dict.fromkeys(keys, HISTORY), "action": CHUNK}


def assert_same(fast: FastDataset, slow: Any, *, batch: int = 16, seed: int = 0) -> None:
    """Compare all items, in batches of a shuffled order."""
    assert len(fast) == len(slow) > 0
    order = np.random.default_rng(seed).permutation(len(slow)).tolist()
    for start in range(0, len(order), batch):
        rows = order[start : start + batch]
        for row, item in zip(rows, fast.__getitems__(rows), strict=True):
            assert_same_item(item, slow[row])


@pytest.mark.parametrize("kind", quick("images"))
def test_every_item_is_equal(kind: str, roots: dict[str, Path]) -> None:
    fast, slow = pair(roots[kind])
    assert_same(fast, slow)
    assert_same_item(fast[7], slow[7])
    assert_same_item(fast[-1], slow[-1])


@pytest.mark.parametrize("kind", quick("videos"))
def test_every_window_is_equal(kind: str, roots: dict[str, Path]) -> None:
    _, plain = pair(roots[kind])
    fast, slow = pair(roots[kind], delta_timestamps=windows(plain), return_uint8=False, depth_output_unit="m")
    assert_same(fast, slow)


@pytest.mark.parametrize("as_bytes", [True, False])
def test_torchcodec_gives_equal_items_too(as_bytes: bool, roots: dict[str, Path]) -> None:
    try:
        import torchcodec.decoders  # noqa: F401
    except (ImportError, RuntimeError, OSError) as error:
        pytest.skip(f"torchcodec does not load here: {str(error).splitlines()[0]}")
    root = roots["videos"]
    _, plain = pair(root)
    assert_same(*pair(root, video_backend="torchcodec", delta_timestamps=windows(plain), return_uint8=as_bytes))


def test_some_episodes_only(roots: dict[str, Path]) -> None:
    chosen = {"episodes": [3, 1, 2], "episode_filter": lambda episode: episode["length"] < 11}
    fast, slow = pair(roots["videos"], delta_timestamps={CAMERA: HISTORY, "action": CHUNK}, **chosen)
    assert fast.episodes == slow.episodes == [2, 3]
    assert fast.absolute_to_relative_idx == slow.absolute_to_relative_idx
    assert_same(fast, slow)


def test_transforms_draw_the_same_random_numbers(roots: dict[str, Path]) -> None:
    import torch

    def noisy(image: torch.Tensor) -> torch.Tensor:
        return image + torch.rand(image.shape[-3:])

    fast, slow = pair(roots["videos"], image_transforms=noisy)
    torch.manual_seed(3)
    wanted = [slow[row] for row in (5, 30, 2)]
    torch.manual_seed(3)
    for found, item in zip(fast.__getitems__([5, 30, 2]), wanted, strict=True):
        assert_same_item(found, item)
    for dataset in (fast, slow):
        dataset.clear_image_transforms()
    assert_same_item(fast[5], slow[5])


@pytest.mark.parametrize(
    "start_method",
    [
        None,
        pytest.param("fork", marks=pytest.mark.slow),
        pytest.param("spawn", marks=(pytest.mark.slow, pytest.mark.long)),
    ],
)
def test_batches_of_a_loader_are_equal(start_method: str | None, roots: dict[str, Path]) -> None:
    import torch

    workers = {"num_workers": 2, "multiprocessing_context": start_method} if start_method else {}

    def loader(dataset: Any, **arguments: Any) -> Any:
        sampler = torch.utils.data.SubsetRandomSampler(range(len(dataset)), torch.Generator().manual_seed(0))
        return torch.utils.data.DataLoader(dataset, batch_size=7, sampler=sampler, **arguments)

    fast, slow = pair(roots["videos"], delta_timestamps={CAMERA: HISTORY, "action": CHUNK})
    assert_same_item(fast[0], slow[0])  # so that forked workers inherit open files
    batches = zip(loader(fast, **workers), loader(slow), strict=True)
    for found, wanted in batches:
        assert_same_item(found, wanted)


def test_a_pickled_dataset_carries_no_arrays_and_no_files(roots: dict[str, Path]) -> None:
    fast, slow = pair(roots["videos"])
    assert_same_item(fast[0], slow[0])
    before = len(pickle.dumps(fast))
    fast.__getitems__(range(len(fast)))
    assert len(pickle.dumps(fast)) == before
    assert_same_item(pickle.loads(pickle.dumps(fast))[3], slow[3])


def test_a_dataset_being_written_is_refused_and_then_read(tmp_path: Path) -> None:
    from lerobot_policy_act_keypoints import FastDataset

    features = {"action": {"dtype": "float32", "shape": (2,), "names": None}}
    dataset = FastDataset.create("local/test", 30, features, root=tmp_path / "d")
    for value in (1.0, 2.0, 3.0):
        dataset.add_frame({"action": np.full(2, value, np.float32), "task": "go"})
    dataset.save_episode()
    with pytest.raises(RuntimeError, match="finalize"):
        dataset.__getitems__([0])
    dataset.finalize()
    assert [item["action"].tolist() for item in dataset.__getitems__([2, 0])] == [[3.0, 3.0], [1.0, 1.0]]


def test_what_cannot_be_read_is_refused_as_by_lerobot(roots: dict[str, Path]) -> None:
    from lerobot.datasets.video_utils import FrameTimestampError

    fast, slow = pair(roots["videos"])
    for index in (len(slow), -len(slow) - 1):
        for dataset in (fast, slow):
            with pytest.raises(IndexError):
                dataset[index]
    # A table of episodes with the images' times shifted by 10 ms.
    for dataset in (fast, slow):
        key = f"videos/{CAMERA}/from_timestamp"
        dataset.meta.episodes = dataset.meta.episodes.map(lambda row, key=key: {key: row[key] + 0.01})
        dataset._ensure_reader()._tables = None
        with pytest.raises(FrameTimestampError):
            dataset[4]

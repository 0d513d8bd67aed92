"""The reader for training against LeRobot's own: the same items, bit for bit, whoever wrote the dataset."""

from __future__ import annotations

import json
import pickle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.docs import run_examples
from support.export import export, make_run
from support.training import CAMERA, assert_same_item, write_by_lerobot

if TYPE_CHECKING:
    import torch

    from demorec.learn.training import FastDataset

LENGTHS = (7, 11, 5, 9)
KINDS = ("ours", "lerobot", "lerobot_images", "lerobot_long_gops")
"""All but the last with depth; LeRobot codes colours as AV1, those of the last as H.264 in long groups."""


def quick(*chosen: str) -> list[Any]:
    """All kinds, those that are not chosen as long tests: LeRobot's reader takes its time."""
    return [kind if kind in chosen else pytest.param(kind, marks=pytest.mark.long) for kind in KINDS]


HISTORY = [-2 / 30, 0.0]
CHUNK = [k / 30 for k in range(16)]


pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("hf_datasets_cache")]


@pytest.fixture(scope="module")
def roots(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Kind -> a dataset, made when it is asked for."""
    return _Made(tmp_path_factory.mktemp("datasets"))


class _Made(dict[str, Path]):
    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def __missing__(self, kind: str) -> Path:
        from lerobot.configs import RGBEncoderConfig

        root = self[kind] = self._folder / kind
        long_gops = RGBEncoderConfig(vcodec="h264", g=12, extra_options={"bf": "2"})
        if kind == "ours":
            run = make_run(self._folder / "run", LENGTHS, depth=True)
            export(run, root, privileged=True, depth=True, video_files_mb=0.002, data_files_mb=0.004)
        elif kind == "lerobot_images":
            write_by_lerobot(root, LENGTHS, stored_as="image", depth=True)
        elif kind == "lerobot_long_gops":
            write_by_lerobot(root, LENGTHS, rgb_encoder=long_gops)
        else:
            write_by_lerobot(root, LENGTHS, depth=True)
        for folder in (root / "data", *(root / "videos").glob("*")):
            assert len(list(folder.rglob("file-*"))) > 1, folder
        return root


def pair(root: Path, **arguments: Any) -> tuple[FastDataset, Any]:
    """Both readers with the same arguments."""
    from lerobot.datasets import LeRobotDataset

    from demorec.learn.training import FastDataset

    arguments = {"root": root, "video_backend": "pyav", "return_uint8": True, **arguments}
    return FastDataset("local/test", **arguments), LeRobotDataset("local/test", **arguments)


def windows(dataset: Any) -> dict[str, list[float]]:
    """A history of two of all that is observed, and a chunk of actions, as policies ask for them."""
    texts = {key for key, feature in dataset.meta.features.items() if feature["dtype"] == "string"}
    keys = [key for key in dataset.meta.features if key.startswith("observation.") and key not in texts]
    return {**dict.fromkeys(keys, HISTORY), "action": CHUNK}


def assert_same(fast: FastDataset, slow: Any, *, batch: int = 16, seed: int = 0) -> None:
    """All items, in batches of a shuffled order."""
    assert len(fast) == len(slow) > 0
    order = np.random.default_rng(seed).permutation(len(slow)).tolist()
    for start in range(0, len(order), batch):
        rows = order[start : start + batch]
        for row, item in zip(rows, fast.__getitems__(rows), strict=True):
            assert_same_item(item, slow[row])


@pytest.mark.parametrize("kind", quick("lerobot_images"))
def test_every_item_is_equal(kind: str, roots: dict[str, Path]) -> None:
    fast, slow = pair(roots[kind])
    assert_same(fast, slow)
    assert_same_item(fast[7], slow[7])
    assert_same_item(fast[-1], slow[-1])


@pytest.mark.parametrize("kind", quick("ours"))
def test_every_window_is_equal(kind: str, roots: dict[str, Path]) -> None:
    _, plain = pair(roots[kind])
    fast, slow = pair(roots[kind], delta_timestamps=windows(plain), return_uint8=False, depth_output_unit="m")
    assert_same(fast, slow)


@pytest.mark.parametrize("kind", ["ours", "lerobot"])
def test_torchcodec_gives_equal_items_too(kind: str, roots: dict[str, Path]) -> None:
    try:
        import torchcodec.decoders  # noqa: F401
    except (ImportError, RuntimeError, OSError) as error:
        pytest.skip(f"torchcodec does not load here: {str(error).splitlines()[0]}")
    _, plain = pair(roots[kind])
    as_bytes = kind == "ours"
    assert_same(*pair(roots[kind], video_backend="torchcodec", delta_timestamps=windows(plain), return_uint8=as_bytes))


def test_language_is_equal(tmp_path: Path) -> None:
    root = tmp_path / "spoken"
    export(make_run(tmp_path / "run", (5, 6)), root, language=())
    path = next((root / "data").glob("*/*.parquet"))
    table = pq.read_table(path)
    rows = table.column("language_events").to_pylist()
    call = {"type": "function", "function": {"name": "say", "arguments": {"text": "Yes, the red one."}}}
    rows[3] = [
        {"role": "user", "content": "No, the red one.", "style": None, "camera": None, "tool_calls": None},
        {"role": "assistant", "content": None, "style": None, "camera": None, "tool_calls": [json.dumps(call)]},
    ]
    fields = dict.fromkeys(("role", "content", "style", "camera"), pa.string()) | {"tool_calls": pa.list_(pa.string())}
    column = pa.array(rows, pa.list_(pa.struct(list(fields.items()))))
    pq.write_table(table.set_column(table.column_names.index("language_events"), "language_events", column), path)
    fast, slow = pair(root)
    assert_same(fast, slow)
    assert fast[3]["language_events"][1]["tool_calls"] == [call]
    assert len(fast[3]["language_persistent"]) > 3
    assert list(fast[3]["language_persistent"][0])[3] == "timestamp"
    assert fast[3]["language_persistent"][0] is not fast[4]["language_persistent"][0]


def test_rows_that_say_nearly_the_same_are_told_apart(tmp_path: Path) -> None:
    """What stands in many rows is read once, whoever wrote the dataset: only where it is the same to the bit."""
    root = tmp_path / "spoken"
    export(make_run(tmp_path / "run", (6, 6)), root, language=())
    path = next((root / "data").glob("*/*.parquet"))
    table = pq.read_table(path)
    column = table.column("language_persistent")
    rows = column.to_pylist()
    rows[2][1]["content"] = "something else"
    rows[3][0]["timestamp"] = -0.0
    rows[5] = []
    rows[8] = rows[8][1:]
    rows[9][2]["content"] = None
    own = pa.array(
        [[{**said, "tool_calls": None} for said in row] for row in rows], pa.list_(_plain_state(column.type))
    )
    pq.write_table(table.set_column(table.column_names.index("language_persistent"), "language_persistent", own), path)
    fast, slow = pair(root)
    assert_same(fast, slow)
    assert [len({str(fast[row]["language_persistent"]) for row in rows}) for rows in ((0, 1, 2, 3), (7, 8, 9))] == [
        3,
        3,
    ]
    fast[6]["language_persistent"][0]["content"] = "changed by somebody"
    assert_same(fast, slow)


def _plain_state(kind: pa.ListType) -> pa.StructType:
    """Statements with calls as text: pyarrow makes no JSON of Python's values."""
    calls = pa.field("tool_calls", pa.list_(pa.string()))
    return pa.struct([calls if field.name == "tool_calls" else field for field in kind.value_type])


def test_some_episodes_only(roots: dict[str, Path]) -> None:
    chosen = {"episodes": [3, 1, 2], "episode_filter": lambda episode: episode["length"] < 11}
    fast, slow = pair(roots["lerobot"], delta_timestamps={CAMERA: HISTORY, "action": CHUNK}, **chosen)
    assert fast.episodes == slow.episodes == [2, 3]
    assert fast.absolute_to_relative_idx == slow.absolute_to_relative_idx
    assert_same(fast, slow)


def test_transforms_draw_the_same_random_numbers(roots: dict[str, Path]) -> None:
    import torch

    def noisy(image: torch.Tensor) -> torch.Tensor:
        return image + torch.rand(image.shape[-3:])

    fast, slow = pair(roots["ours"], image_transforms=noisy)
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

    fast, slow = pair(roots["lerobot"], delta_timestamps={CAMERA: HISTORY, "action": CHUNK})
    assert_same_item(fast[0], slow[0])  # so that forked workers inherit open files
    batches = zip(loader(fast, **workers), loader(slow), strict=True)
    for found, wanted in batches:
        assert_same_item(found, wanted)


def test_a_pickled_dataset_carries_no_arrays_and_no_files(roots: dict[str, Path]) -> None:
    fast, slow = pair(roots["ours"])
    assert_same_item(fast[0], slow[0])
    before = len(pickle.dumps(fast))
    fast.__getitems__(range(len(fast)))
    assert len(pickle.dumps(fast)) == before
    assert_same_item(pickle.loads(pickle.dumps(fast))[3], slow[3])


def test_a_dataset_being_written_is_refused_and_then_read(tmp_path: Path) -> None:
    from demorec.learn.training import FastDataset

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

    fast, slow = pair(roots["ours"])
    for index in (len(slow), -len(slow) - 1):
        for dataset in (fast, slow):
            with pytest.raises(IndexError):
                dataset[index]
    # A table of episodes that places the images 10 ms beside where they are.
    for dataset in (fast, slow):
        key = "videos/observation.images.front/from_timestamp"
        dataset.meta.episodes = dataset.meta.episodes.map(lambda row, key=key: {key: row[key] + 0.01})
        dataset._ensure_reader()._tables = None
        with pytest.raises(FrameTimestampError):
            dataset[4]


def test_the_example_of_the_docs_runs(roots: dict[str, Path]) -> None:
    assert run_examples("docs/training.md", "FastDataset", {"recordings/demo/dataset": roots["ours"]}) == 1

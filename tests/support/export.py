"""Runs of synthetic episodes and datasets made from them, for the tests of exports."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from numpy.typing import NDArray

from demorec.core.config import VideoConfig
from demorec.core.tables import EXPORTERS
from demorec.datasets.lerobot import export as lerobot_export
from demorec.datasets.lerobot import prepare
from demorec.datasets.lerobot.layout import DatasetInfo
from demorec.datasets.options import ExportReport
from demorec.extensions.doctor.checks import lerobot_opens
from support.recording import write_episode


def recordings(run: Path) -> list[Path]:
    """Recordings of the episodes of a run, in order."""
    return sorted((run / "episodes").glob("*.mcap"))


def make_run(
    folder: Path,
    lengths: Sequence[int],
    *,
    failures: Sequence[int] = (),
    video: VideoConfig | None = None,
    **arguments: object,
) -> Path:
    """Write a run with successful episodes of the given lengths, and a failed attempt for each index of `failures`."""
    (folder / "episodes").mkdir(parents=True)
    (folder / "failed").mkdir()
    for index, length in enumerate(lengths):
        path = folder / "episodes" / f"episode_{index:06d}.mcap"
        write_episode(path, video=video, num_frames=length, episode_index=index, **arguments)
    for index in failures:
        path = folder / "failed" / f"episode_{index:06d}.attempt_0.mcap"
        write_episode(path, video=video, num_frames=12, episode_index=index, success=False, **arguments)
    return folder


def content_of(place: Path) -> dict[str, bytes]:
    """Relative path -> content of every file of a folder; "" -> that of a single file; empty if the path does not
    exist.
    """
    return {"": place.read_bytes()} if place.is_file() else files_of(place)


def feature_of(dataset: Path, name: str, exporter: str) -> tuple[NDArray[Any], list[str]]:
    """(T, D) of a feature in the first episode of an export, and the names of its elements."""
    if exporter == "lerobot":
        rows = np.array(data_table(dataset).column(name).to_pylist(), dtype=np.float32)
        return rows.reshape(len(rows), -1), info(dataset)["features"][name]["names"]
    assert exporter == "hdf5", f"feature_of in tests/support/export.py needs lines that read the format {exporter}"
    with h5py.File(dataset) as file:
        stored = file["data/demo_0/obs"][name.removeprefix("observation.")]
        return stored[()], json.loads(stored.attrs["names"])


def export(sources: Path | Sequence[Path], out: Path, exporter: str = "lerobot", **options: Any) -> ExportReport:
    """Export by a row of the table; exports to LeRobot are verified only on request."""
    sources = [sources] if isinstance(sources, Path) else sources
    row = EXPORTERS.load(exporter)
    defaults = {"verify": False} if exporter == "lerobot" else {}
    return row.export(sources, out, row.options(**{**defaults, **options}), None)


def without_verification(patch: pytest.MonkeyPatch) -> None:
    """Skip the verification as if LeRobot, which takes seconds to load, were not installed."""
    for module in (lerobot_export, lerobot_opens):
        patch.setattr(module, "lerobot_is_installed", lambda: False)


def export_in_files(
    sources: Path, out: Path, *, data_mb: float, video_mb: float, chunk: int = 1000, **options: Any
) -> ExportReport:
    """Export to LeRobot with other limits of files and chunk folders than its defaults."""
    limits: dict[str, Any] = {
        "data_files_size_in_mb": data_mb,
        "video_files_size_in_mb": video_mb,
        "chunks_size": chunk,
    }
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(prepare, "DatasetInfo", partial(DatasetInfo, **limits))
        return export(sources, out, **options)


def data_table(dataset: Path) -> pa.Table:
    return pa.concat_tables([pq.read_table(path) for path in sorted((dataset / "data").glob("*/*.parquet"))])


def episode_rows(dataset: Path) -> list[dict[str, Any]]:
    return [
        row
        for path in sorted((dataset / "meta" / "episodes").glob("*/*.parquet"))
        for row in pq.read_table(path).to_pylist()
    ]


def info(dataset: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((dataset / "meta" / "info.json").read_text())
    return found


def files_of(folder: Path) -> dict[str, bytes]:
    """Relative path -> content of every file."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()
    }


def recode(video: Path, change: Callable[[list[Any]], object] = lambda images: None) -> None:
    """Encode a video again, losslessly and with keyframes only; `change` edits the list of its images."""
    import av
    from av.video.stream import VideoStream

    with av.open(str(video)) as container:
        rate = container.streams.video[0].average_rate
        images: list[Any] = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    change(images)
    with av.open(str(video), "w") as out:
        stream = out.add_stream("libx264rgb", rate=rate, options={"qp": "0", "g": "1", "bf": "0"})
        assert isinstance(stream, VideoStream)
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = "rgb24"
        for image in images:
            out.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        out.mux(stream.encode(None))


def rewrite_video(dataset: Path, key: str, change: Callable[[list[Any]], list[Any]]) -> None:
    """Change the images of a camera's only file, and encode them at the rate of the dataset."""
    import av

    path = next(dataset.glob(f"videos/{key}/*/*.mp4"))
    with av.open(str(path)) as container:
        images = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    before = np.stack(images)
    changed = change(images)
    assert len(changed) != len(before) or not np.array_equal(np.stack(changed), before)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=info(dataset)["fps"], options={"crf": "18", "g": "2", "bf": "0"})
        stream.height, stream.width = before.shape[1:3]
        stream.pix_fmt = "yuv420p"
        for image in changed:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")))
        container.mux(stream.encode(None))

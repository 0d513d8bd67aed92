"""What stands beside the rows frame by frame, cut as they are: poses of moving cameras, boxes, progress."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from demorec.core.errors import ExportError
from demorec.core.geometry import Array
from demorec.datasets.editing.plan import Cut, Plan, Source
from demorec.datasets.lerobot.boxes import BOXES_DIR, BoxWriter, SeenByCamera, StoredBoxes
from demorec.datasets.lerobot.facts import PROGRESS_PATH, STAGE_COLUMNS, read_progress, write_progress
from demorec.datasets.lerobot.files import column_numbers, open_table, read_table
from demorec.datasets.lerobot.paths import SIDECAR_DIR
from demorec.datasets.staging import sync_file

_COUNTERS = ("index", "episode_index", "frame_index")


def moving_cameras(source: Source) -> tuple[str, ...] | None:
    """Cameras of whose every frame the pose is kept; None where the files do not agree."""
    names = [open_table(path).schema_arrow.names for path in _pose_files(source)]
    if any(each != names[0] for each in names):
        return None
    return tuple(name for name in (names[0] if names else ()) if name not in _COUNTERS)


def _pose_files(source: Source) -> list[Path]:
    return sorted((source.root / SIDECAR_DIR / "camera_poses").glob("*/*.parquet"))


def poses_are_kept(plan: Plan) -> bool:
    """Whether all sources with moving cameras have the same."""
    found = {moving_cameras(source) for source in plan.sources} - {()}
    return len(found) <= 1 and None not in found


class _ByEpisode:
    """Rows of tables with `episode_index` and `frame_index`, in order, found by episode."""

    def __init__(self, paths: Sequence[Path]) -> None:
        tables = [read_table(path) for path in paths]
        self._table = pa.concat_tables(tables).sort_by([(name, "ascending") for name in _COUNTERS[1:]])
        self._episodes = self._table.column("episode_index").to_numpy()

    def read(self, episode: int, first: int, last: int) -> pa.Table:
        """Those of an episode's frames from `first` to before `last`."""
        begin, end = np.searchsorted(self._episodes, [episode, episode + 1])
        rows = self._table.slice(begin, end - begin)
        frames = rows.column("frame_index").to_numpy()
        return rows.filter(pa.array((frames >= first) & (frames < last)))


class CameraPoses:
    """Those of one source."""

    def __init__(self, source: Source) -> None:
        self._root = source.root
        self._names = moving_cameras(source) or ()
        self._rows = _ByEpisode(_pose_files(source)) if self._names else None

    def of(self, episode_index: int, cut: Cut) -> dict[str, Array]:
        """Camera -> (T, 7) world_from_camera; none for an episode without; ExportError where frames lack."""
        rows = self._rows.read(episode_index, cut.first, cut.last) if self._rows is not None else None
        if rows is None or not rows.num_rows:
            return {}
        if rows.num_rows != cut.last - cut.first:
            raise ExportError(f"Poses of cameras are missing in episode {episode_index}: {self._root}")
        return {name: column_numbers(rows.column(name).combine_chunks()) for name in self._names}


class Boxes:
    """The files of boxes, which go along with their cameras; `finish` completes them."""

    def __init__(self, plan: Plan, folder: Path) -> None:
        self._plan = plan
        self._writer = BoxWriter(folder, fps=plan.info.fps)
        self._files = [
            {
                name: StoredBoxes(path, [place.from_index for place in source.dataset.places])
                for name, take in takes.items()
                if (path := source.root / BOXES_DIR / f"{take.feature}.json").is_file()
            }
            for source, takes in zip(plan.sources, plan.takes, strict=True)
        ]

    def add(self, episode: int, cut: Cut) -> None:
        """Those of a cut, which is that episode of the new dataset."""
        found: dict[str, SeenByCamera] = {}
        for name, file in self._files[cut.source].items():
            if (seen := file.read(cut.episode, cut.first, cut.last)) is not None:
                found[name] = seen
        self._writer.add(episode, found, cut.last - cut.first)

    def finish(self) -> None:
        """Complete all files."""
        self._writer.finish()

    def close(self) -> None:
        """Let go of files that were not completed."""
        self._writer.__exit__()


def has_stages(plan: Plan) -> bool:
    """Whether progress is computed anew, from the stages that demorec wrote."""
    needed = {*STAGE_COLUMNS, "num_goals"}
    return all(source.has_sidecar and needed <= set(source.fact_types) for source in plan.sources)


def progress_is_kept(plan: Plan) -> bool:
    """Whether all sources have progress of the same kind."""
    paths = [source.root / PROGRESS_PATH for source in plan.sources]
    if not all(path.is_file() for path in paths):
        return False
    schemas = [open_table(path).schema_arrow for path in paths]
    return has_stages(plan) or (
        set(_COUNTERS) <= set(schemas[0].names) and all(schema.equals(schemas[0]) for schema in schemas)
    )


def write_kept_progress(plan: Plan, folder: Path) -> None:
    """Write the progress of the new dataset's rows: from stages, else as the sources have it of each frame."""
    if has_stages(plan):
        write_progress(folder, read_progress(folder))
        return
    sources = [_ByEpisode([source.root / PROGRESS_PATH]) for source in plan.sources]
    parts, total = [], 0
    for episode, cut in enumerate(plan.cuts):
        index = plan.sources[cut.source].dataset.places[cut.episode].episode_index
        rows = sources[cut.source].read(index, cut.first, cut.last)
        frames = rows.column("frame_index").to_numpy() - cut.first
        counted = {"index": frames + total, "episode_index": np.full(len(frames), episode), "frame_index": frames}
        for name, values in counted.items():
            number = rows.schema.get_field_index(name)
            rows = rows.set_column(number, rows.schema.field(name), pa.array(values, rows.schema.field(name).type))
        parts.append(rows)
        total += cut.last - cut.first
    pq.write_table(pa.concat_tables(parts), folder / PROGRESS_PATH)
    sync_file(folder / PROGRESS_PATH)

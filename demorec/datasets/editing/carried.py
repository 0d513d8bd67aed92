"""What stands beside the rows frame by frame, cut as they are: poses of moving cameras, boxes, progress."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from demorec.core.errors import ExportError
from demorec.core.geometry import Array
from demorec.datasets.editing.plan import Cut, Plan, Source
from demorec.datasets.lerobot.boxes import BOXES_DIR, BoxWriter, SeenByCamera, StoredBoxes
from demorec.datasets.lerobot.facts import PROGRESS_PATH, STAGE_COLUMNS, read_progress, write_progress
from demorec.datasets.lerobot.files import column_numbers, open_table
from demorec.datasets.lerobot.paths import SIDECAR_DIR
from demorec.datasets.lerobot.reader import EpisodeRows
from demorec.datasets.staging import sync_file

_COUNTERS = ("index", "episode_index", "frame_index")
_ROWS_AT_ONCE = 4096


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


class CameraPoses:
    """Those of one source."""

    def __init__(self, source: Source) -> None:
        self._root = source.root
        self._names = moving_cameras(source) or ()
        self._rows = EpisodeRows(_pose_files(source), rows=_ROWS_AT_ONCE) if self._names else None

    def of(self, episode_index: int, cut: Cut) -> dict[str, Array]:
        """Camera -> (T, 7) world_from_camera; none for an episode without; ExportError where frames lack."""
        rows = self._rows.frames(episode_index, cut.first, cut.last) if self._rows is not None else None
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
                name: StoredBoxes(path, [place.from_index for place in source.places])
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
    return all(source.sidecar_tables and needed <= set(source.fact_types) for source in plan.sources)


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
    path, total = folder / PROGRESS_PATH, 0
    sources = [EpisodeRows([source.root / PROGRESS_PATH], rows=_ROWS_AT_ONCE) for source in plan.sources]
    schema = open_table(plan.sources[0].root / PROGRESS_PATH).schema_arrow
    waiting: list[pa.Table] = []
    with pq.ParquetWriter(path, schema) as writer:
        for episode, cut in enumerate(plan.cuts):
            index = plan.sources[cut.source].places[cut.episode].episode_index
            if (rows := sources[cut.source].frames(index, cut.first, cut.last)) is not None:
                waiting.append(_counted(rows, cut, episode, total))
            total += cut.last - cut.first
            if sum(rows.num_rows for rows in waiting) >= _ROWS_AT_ONCE or cut is plan.cuts[-1]:
                writer.write_table(pa.concat_tables([schema.empty_table(), *waiting]))
                waiting.clear()
    sync_file(path)


def _counted(rows: pa.Table, cut: Cut, episode: int, index: int) -> pa.Table:
    """Rows of a cut with their numbers in the new dataset, in which `index` is that of its first frame."""
    frames = rows.column("frame_index").to_numpy() - cut.first
    counted = {"index": frames + index, "episode_index": np.full(len(frames), episode), "frame_index": frames}
    for name, values in counted.items():
        number = rows.schema.get_field_index(name)
        rows = rows.set_column(number, rows.schema.field(name), pa.array(values, rows.schema.field(name).type))
    return rows

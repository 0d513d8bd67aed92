"""Write a planned dataset in one pass: rows and packets pass through, counters and statistics are recomputed."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Mapping
from itertools import compress, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from PIL import Image

from demorec.core.errors import ExportError
from demorec.core.files import open_regular
from demorec.datasets.lerobot.files import column_numbers
from demorec.datasets.lerobot.language import COLUMNS, EpisodeLanguage, language_arrays, spoken_of
from demorec.datasets.lerobot.layout import DatasetFeature
from demorec.datasets.lerobot.mp4 import EncodedVideo
from demorec.datasets.lerobot.stats import NAMES, PixelHistogram, Statistics, colour_levels
from demorec.datasets.lerobot.writer import DatasetStart, DatasetWriter, EpisodeData
from demorec.datasets.options import ProgressCallback
from demorec.extensions.datasets.beside import copied_files, kept_configs, kept_export, sidecar_record
from demorec.extensions.datasets.episode_places import EpisodePlace, are_on_grid
from demorec.extensions.datasets.folder import LeRobotFolder
from demorec.extensions.datasets.inspect import episode_statistics, statistics_from_json
from demorec.extensions.datasets.plan import EpisodeSlice, FeatureMapping, Plan, reference_columns
from demorec.extensions.datasets.rows import EpisodeTable
from demorec.extensions.datasets.videos import EpisodeVideo

if TYPE_CHECKING:
    from demorec.mcap.video import Rgb

_NUMBERS = tuple(name for name in NAMES if name != "count")
_STAGE_PARTS = ("names", "start_frames", "end_frames", "start_times", "end_times")
_OF_THE_END = ("next.done", "next.success", "next.reward")


def write_plan(
    plan: Plan, folder: Path, *, decode: bool = False, progress: ProgressCallback | None = None
) -> tuple[int, int]:
    """Write a dataset to an empty folder; its sources are not changed.

    Args:
        plan: Episodes and features of the dataset.
        folder: Its folder.
        decode: Whether to decode all images for their statistics, even if an episode's are known.
        progress: Called after every episode.

    Returns:
        Number of episodes whose images were decoded for their statistics, and number of images next to cuts that stay
        in the videos because others are decoded from them.

    Raises:
        ExportError: A source is damaged.
        OSError: The dataset cannot be written.
    """
    readers = [_Reader(plan, number, decode=decode) for number in range(len(plan.sources))]
    # For conflicting types the first source's.
    facts = {name: kind for source in reversed(plan.sources) for name, kind in source.fact_types.items()}
    start = DatasetStart(info=plan.info, facts=facts, tasks=plan.kept_tasks, configs=kept_configs(plan))
    with DatasetWriter(folder, start) as writer:
        around = 0
        for done, cut in enumerate(plan.cuts, start=1):
            data = readers[cut.source].episode(cut)
            around += sum(video.lead + video.tail for video in data.videos.values())
            writer.add(data)
            if progress is not None:
                progress(done, len(plan.cuts))
        writer.finish(kept_export(plan))
    for name in copied_files(plan):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        with open_regular(plan.sources[0].root / name) as source_file, (folder / name).open("wb") as target:
            shutil.copyfileobj(source_file, target)
    return sum(reader.num_decoded for reader in readers), around


class _Reader:
    """Reader of one source's episodes for the plan."""

    def __init__(self, plan: Plan, number: int, *, decode: bool) -> None:
        self._plan, self.source = plan, plan.sources[number]
        self.num_decoded = 0
        self._features, self._fps = plan.info.features, plan.info.fps
        self._mappings: Mapping[str, FeatureMapping] = plan.mappings[number]
        info = self.source.info
        names = {mapping.feature for mapping in self._mappings.values()}
        self._names = [name for name in info.features if name in names and not info.features[name].is_video]
        self._rows = self.source.rows([*self._names, "task_index", "timestamp"])
        self._references = reference_columns(info)
        self._task_numbers = plan.task_numbers(number)
        tables = self.source.episode_tables if self.source.fact_types else ()
        self._fact_rows = EpisodeTable(tables, pa.schema(list(self.source.fact_types.items())))
        self._known = {} if decode or not self.source.keeps_statistics else _kept_statistics(self.source)
        self._has_sidecar = any(source.sidecar_tables for source in plan.sources)

    def episode(self, cut: EpisodeSlice) -> EpisodeData:
        """Read an episode."""
        place = self.source.places[cut.episode]
        all_rows = self._rows.read(place)
        rows = all_rows.slice(cut.first, cut.last - cut.first)
        whole = self._plan.is_whole(cut)
        columns: dict[str, Any] = {}
        videos: dict[str, EncodedVideo] = {}
        video_info: dict[str, dict[str, Any]] = {}
        pixels: dict[str, PixelHistogram | Statistics] = {}
        language = EpisodeLanguage()
        annotated: set[str] = set()
        num_decoded = 0
        for name, mapping in self._mappings.items():
            feature = self._features[name]
            if feature.dtype == "language":
                language = self._language(rows, cut)
                continue
            if mapping.feature in self._references:
                values = column_numbers(self._column(rows, mapping, feature))
                columns[name] = self._renumbered(values)
                annotated.update(task for number, task in enumerate(self.source.tasks) if number in values)
                continue
            if feature.is_video:
                stored = self.source.video(mapping.feature, place)
                video = stored.cut(cut.first, cut.last)
                videos[name] = video.with_digest() if self._has_sidecar else video
                video_info[name] = feature.info or stored.file.stream_info()
            else:
                columns[name] = self._column(rows, mapping, feature)
                if mapping.feature in _OF_THE_END and cut.has_end and cut.last != place.length:
                    columns[name] = _with_end(columns[name], self._column(all_rows, mapping, feature))
            if feature.is_camera:
                known = self._kept(place, mapping.feature) if whole else None
                pixels[name] = known or self._counted(mapping.feature, cut, rows)
                num_decoded += known is None
        columns |= language_arrays(language, len(rows))
        self.num_decoded += num_decoded > 0
        tasks = [cut.task] if cut.task else self._tasks(rows)
        return EpisodeData(
            task=tasks[0],
            columns=columns,
            videos=videos,
            video_info=video_info,
            pixels=pixels,
            facts=self._facts(cut, place),
            row_tasks=tasks if len(set(tasks)) > 1 else (),
            annotated_tasks=[task for task in place.tasks if task in annotated],
            timestamps=self._timestamps(rows, cut),
            record=sidecar_record(self._plan, cut) if self._has_sidecar else None,
        )

    def _renumbered(self, values: NDArray[np.int64]) -> NDArray[np.int64]:
        """Replace task numbers; other values stay."""
        is_task = (values >= 0) & (values < len(self._task_numbers))
        found = values.copy()
        found[is_task] = self._task_numbers[values[is_task]]
        return found

    def _timestamps(self, rows: pa.Table, cut: EpisodeSlice) -> NDArray[Any] | None:
        """(T,) timestamps of a cut, from 0 and rounded once; None for multiples of 1/fps."""
        if not self.source.keeps_timestamps:
            return None
        stored: NDArray[Any] = column_numbers(rows.column("timestamp").combine_chunks())[:, 0]
        if not cut.first:
            return stored
        seconds = stored.astype(np.float64)
        if are_on_grid(seconds, self._fps, seconds[0]):
            return None
        measured: NDArray[Any] = (seconds - seconds[0]).astype(stored.dtype)
        return measured

    def _kept(self, place: EpisodePlace, key: str) -> Statistics | None:
        """The source's statistics of an episode, weighted by its frames; None if it has none."""
        if (found := self._known.get((place.episode_index, key))) is None:
            return None
        values = dict(zip(_NUMBERS, found[1], strict=True))
        return Statistics(values=values, count=min(found[0], place.length), is_camera=True)

    def _counted(self, key: str, cut: EpisodeSlice, rows: pa.Table) -> PixelHistogram:
        """Histogram of a camera's pixels in a cut, from its rows."""
        place, feature = self.source.places[cut.episode], self.source.info.features[key]
        if feature.is_video:
            return _video_histogram(self.source.video(key, place), feature, cut.first, cut.last)
        return _histogram(self.source.stored_images[key].decode(place, rows.column(key).chunks))

    def _column(self, rows: pa.Table, mapping: FeatureMapping, feature: DatasetFeature) -> Any:
        array = rows.column(mapping.feature).combine_chunks()
        array = array if isinstance(array, pa.Array) else pa.concat_arrays(array.chunks)
        if not mapping.is_copy:
            return mapping.apply(column_numbers(array), feature.dtype)
        if feature.dtype == "image" and not pa.types.is_struct(array.type):  # plain bytes, which LeRobot also reads
            array = pa.StructArray.from_arrays(
                [array.cast(pa.binary()), pa.nulls(len(array), pa.string())], names=["bytes", "path"]
            )
        elif feature.dtype == "image":
            array = pa.StructArray.from_arrays(
                [array.field("bytes"), array.field("path").cast(pa.string())], names=["bytes", "path"]
            )
        return array

    def _tasks(self, rows: pa.Table) -> list[str]:
        tasks, found = self.source.tasks, rows.column("task_index").to_numpy()
        if found.dtype.kind == "f" and (found % 1 == 0).all():
            found = found.astype(np.int64)
        if found.dtype.kind != "i" or found.min() < 0 or found.max() >= len(tasks):
            raise ExportError(f"A row names a task that is not in the table of tasks: {self.source.root}")
        first = tasks[found[0]]
        return [first] if (found == found[0]).all() else [tasks[index] for index in found.tolist()]

    def _language(self, rows: pa.Table, cut: EpisodeSlice) -> EpisodeLanguage:
        """Language of these rows, with times counted from the first of them."""
        spoken = spoken_of(rows.select(COLUMNS).to_batches(), self.source.root)
        latest: dict[str, dict[str, Any]] = {}
        kept = []
        for row in spoken.persistent:
            if cut.task and row.get("style") == "task_aug":
                continue  # wordings of the old instruction, which LeRobot would use instead of the new one
            time = row.get("timestamp")
            frame = None if time is None else round(time * self._fps) - cut.first
            if frame is None or not cut.first:
                kept.append(row)
            elif frame <= 0:
                latest[str(row.get("style"))] = {**row, "timestamp": 0.0}
            elif frame < cut.last - cut.first:
                kept.append({**row, "timestamp": float(np.float32(frame / self._fps))})
        if cut.first == 0:
            end = (cut.last - 0.5) / self._fps
            kept = [row for row in kept if row.get("timestamp") is None or row["timestamp"] < end]
        return EpisodeLanguage(persistent=[*latest.values(), *kept], events=spoken.events)

    def _facts(self, cut: EpisodeSlice, place: EpisodePlace) -> dict[str, Any]:
        facts = self._fact_rows.row(place.episode_index)
        if "success" in facts and not cut.has_end:
            facts["success"] = None
        return facts if self._plan.is_whole(cut) else facts | _cut_stages(facts, cut, self._fps)


def _cut_stages(facts: Mapping[str, Any], cut: EpisodeSlice, fps: int) -> dict[str, Any]:
    """Stages as LeRobot's SARM annotates them, within a cut, with frames and seconds counted from its first frame."""
    found: dict[str, Any] = {}
    for stem in (name.removesuffix("names") for name in facts if name.endswith("subtask_names")):
        columns = {name: facts[name] for part in _STAGE_PARTS if facts.get(name := f"{stem}{part}")}
        edges = zip(columns.get(f"{stem}start_frames", ()), columns.get(f"{stem}end_frames", ()), strict=False)
        inside = [first < cut.last and last >= cut.first for first, last in edges]
        for name, values in columns.items() if inside else ():
            kept = list(compress(values, inside))
            if name.endswith("_frames"):
                kept = [min(max(frame, cut.first), cut.last - 1) - cut.first for frame in kept]
            elif name.endswith("_times"):
                kept = [min(max(time, cut.first / fps), cut.last / fps) - cut.first / fps for time in kept]
            found[name] = kept
    return found


def _with_end(kept: pa.Array, column: pa.Array) -> pa.Array:
    """A cut column with the values of the episode's last row in its last row, such as the outcome."""
    if column_numbers(column)[:-1].any():
        return kept
    return pa.concat_arrays([kept[:-1], column[-1:]])


def _kept_statistics(source: LeRobotFolder) -> dict[tuple[int, str], tuple[int, NDArray[np.float64]]]:
    """(episode_index, camera) -> count and (9, C) statistics of each episode in the dataset."""
    keys = [name for name, feature in source.info.features.items() if feature.is_camera]
    found: dict[tuple[int, str], tuple[int, NDArray[np.float64]]] = {}
    for number, key, entry in episode_statistics(source, keys):
        try:
            part = statistics_from_json(entry)
            values = None if part is None else np.stack([part.values[name] for name in _NUMBERS])
        except (ValueError, TypeError):
            continue
        if part is not None and values is not None and np.isfinite(values).all():
            found[number, key] = part.count, values
    return found


def _video_histogram(video: EpisodeVideo, feature: DatasetFeature, first: int, last: int) -> PixelHistogram:
    """Histogram of some frames of a video, decoded."""
    if not feature.is_depth:
        return _histogram(islice(video.images(first), last - first))
    levels = video.depth_scale.values() * (1000 if (feature.info or {}).get("depth_unit") == "mm" else 1)
    counts = np.zeros((1, len(levels)), dtype=np.int64)
    for codes in islice(video.codes(first), last - first):
        counts[0] += np.bincount(codes.ravel(), minlength=len(levels))
    return PixelHistogram(counts=counts, level_values=levels, num_images=last - first)


def _histogram(images: Iterable[Rgb]) -> PixelHistogram:
    counts, num_images = np.zeros(3 * 256, dtype=np.int64), 0
    for image in images:
        num_images += 1
        counts += Image.fromarray(image).histogram()  # three times as fast as NumPy's bincount
    return PixelHistogram(counts=counts.reshape(3, 256), level_values=colour_levels(), num_images=num_images)

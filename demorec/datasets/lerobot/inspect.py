"""What a dataset holds: attempts, what is missing, and the digest of its content recomputed from its files."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from demorec.core.errors import ExportError, describe_error, resource_error, without_path
from demorec.datasets.lerobot.files import open_table, read_json, read_table, rows_in, tables_in
from demorec.datasets.lerobot.layout import STATS_PATH, DatasetInfo, combined_digest, episode_digest
from demorec.datasets.lerobot.mp4_index import check_video
from demorec.datasets.lerobot.paths import INFO_PATH, SIDECAR_DIR
from demorec.datasets.lerobot.reader import RowStream, episode_places, read_tasks
from demorec.datasets.lerobot.robots import read_robot
from demorec.datasets.lerobot.videos import PacketReader


def attempt_counts(path: Path) -> tuple[int, int] | None:
    """(episodes that succeeded, attempts that were made) of a dataset that demorec wrote; None for anybody else's.

    Raises:
        ExportError: Its tables are damaged.
    """
    attempts = tables_in(path, f"{SIDECAR_DIR}/attempts")
    if not attempts:
        return None
    successes = sum(row["success"] is True for row in rows_in(path, f"{SIDECAR_DIR}/episodes", ["success"]))
    return successes, sum(open_table(file).metadata.num_rows for file in attempts)


def known_units(path: Path) -> Mapping[str, tuple[str, ...]]:
    """Feature -> units of its elements, as demorec keeps them beside its datasets; empty for anybody else's.

    Raises:
        ExportError: The tables or the robot's description are damaged.
    """
    for file in tables_in(path, f"{SIDECAR_DIR}/episodes"):
        if "robot_digest" in open_table(file).schema_arrow.names:
            digests = read_table(file, ["robot_digest"]).column(0).drop_null()
            return read_robot(path, digests[0].as_py()).record.units if len(digests) else {}
    return {}


def dataset_problems(path: Path, info: DatasetInfo) -> list[str]:
    """What of a dataset is missing, emptied or cut off, one sentence each; by the ends of its files, which is quick.

    `demorec check` reads all that is in them.
    """
    problems: list[str] = []
    rows: dict[str, int] = {}
    for place in ("data", *(() if info.is_old else ("meta/episodes",))):
        rows[place] = 0
        for file in tables_in(path, place):
            with _noted(problems, path):
                rows[place] += open_table(file).metadata.num_rows
    if not problems:
        for place, said in (("data", info.total_frames), ("meta/episodes", info.total_episodes)):
            if rows.get(place, said) != said:
                problems.append(f"The tables in {place} have {rows[place]} rows, {INFO_PATH} counts {said}")
    with _noted(problems, path):
        read_tasks(path)
    if not info.is_old and not (path / STATS_PATH).exists():
        problems.append(f"The statistics are missing: {STATS_PATH}")
    with _noted(problems, path):
        check_tables(path)
    with _noted(problems, path):
        for video in sorted({video for place in episode_places(path, info) for video, _ in place.videos.values()}):
            with _noted(problems, path):
                check_video(video)
    return list(dict.fromkeys(problems))


@contextmanager
def _noted(problems: list[str], path: Path) -> Iterator[None]:
    """Turn an ExportError into one more problem, stated without the dataset's own path."""
    try:
        yield
    except ExportError as error:
        if (lack := resource_error(error)) is not None:
            raise lack from error
        problems.append(without_path(error, path).replace(f"{path}/", ""))


def has_digest(info: DatasetInfo) -> bool:
    """Whether the content has a digest: all of it is video, numbers or text, that of language columns included."""
    return not _without_digest(info)


def _without_digest(info: DatasetInfo) -> list[str]:
    return [name for name, feature in info.features.items() if feature.dtype == "image"]


def check_tables(path: Path) -> None:
    """Read the ends of all tables and the JSON files: whether any was emptied or cut off.

    Raises:
        ExportError: One was.
    """
    for file in sorted(path.rglob("*")):
        try:
            if file.suffix == ".parquet":
                open_table(file)
            elif file.suffix == ".json":
                read_json(file)
        except (OSError, ValueError) as error:
            raise ExportError(f"The dataset is damaged ({describe_error(error)}): {file}") from error


def dataset_digest(path: Path) -> str:
    """SHA-256 (hex) of the content, read back from all files; `ExportReport.digest` of a new dataset is the same.

    Raises:
        ExportError: The dataset is damaged.
    """
    info = DatasetInfo.load(path)
    return combined_digest(info, list(episode_digests(path, info)))


def episode_digests(path: Path, info: DatasetInfo) -> list[str]:
    """The digest of every episode, in order, read back from all files."""
    if unknown := _without_digest(info):
        raise ExportError(f"The content of {', '.join(unknown)} has no digest, it is neither video nor numbers: {path}")
    tasks = read_tasks(path)
    rows = RowStream(info)
    cameras = {key: PacketReader(key) for key in info.video_keys}
    result = []
    try:
        for place in episode_places(path, info):
            columns = rows.numbers(place)
            videos = {}
            for key, packets in cameras.items():
                images = hashlib.sha256()
                for sample in packets.read(place):
                    images.update(sample)
                videos[key] = images.hexdigest()
            task_index = columns["task_index"][0, 0] if len(columns["task_index"]) else -1
            if not 0 <= task_index < len(tasks):  # which NaN, what a null was read as, is neither
                raise ExportError(f"Episode {place.episode_index} has no task: {path}")
            task = tasks[int(task_index)]
            result.append(episode_digest(task, columns, videos))
    finally:
        for packets in cameras.values():
            packets.close()
    return result

"""Inspection of a dataset: attempts, missing parts, and the content digest recomputed from its files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from demorec.core.errors import ExportError, describe_error, resource_error, without_path
from demorec.datasets.lerobot.episode_table import EpisodePlace
from demorec.datasets.lerobot.files import open_table, read_json, read_table
from demorec.datasets.lerobot.folder import LeRobotFolder
from demorec.datasets.lerobot.layout import STATS_PATH, DatasetInfo, combined_digest, episode_digest
from demorec.datasets.lerobot.mp4_index import check_video
from demorec.episode.features import ACTION, STATE
from demorec.episode.info import EpisodeInfo
from demorec.episode.validity import read_episode_info


def attempt_counts(folder: LeRobotFolder) -> tuple[int, int, int] | None:
    """Count (successful episodes, episodes without a known outcome, attempts made); None if no outcome is known.

    Raises:
        ExportError: Its tables are damaged.
    """
    attempts = folder.sidecar_tables("attempts")
    if not attempts:
        return None
    outcomes = [row["success"] for row in folder.sidecar(["success"])]
    if all(outcome is None for outcome in outcomes):
        return None
    num_attempts = sum(open_table(file).metadata.num_rows for file in attempts)
    return outcomes.count(True), outcomes.count(None), num_attempts


def known_units(folder: LeRobotFolder) -> Mapping[str, tuple[str, ...]]:
    """Feature -> units of its elements, from the sidecar's robot and first episode; empty without a sidecar.

    An action with the elements of the state has the state's units.

    Raises:
        ExportError: The tables or the robot's description are damaged.
    """
    digests = (row["robot_digest"] for row in folder.sidecar(["robot_digest"]))
    digest = next((digest for digest in digests if digest), None)
    found = {} if digest is None else dict(folder.robot(digest).record.units)
    for row in folder.sidecar_rows("episodes", 0):
        if row.get("episode_info") is not None:
            found = {feature.name: feature.units for feature in recorded_info(row, folder.root).features} | found
    state, action = (folder.info.features.get(name) for name in (STATE, ACTION))
    if STATE in found and state is not None and action is not None and state.names == action.names:
        found.setdefault(ACTION, found[STATE])
    return found


def recorded_info(row: Mapping[str, Any], root: Path) -> EpisodeInfo:
    """Parse the description of a simulated episode in its row of the sidecar; ExportError if it is damaged."""
    try:
        return read_episode_info(row["episode_info"])
    except (ValueError, KeyError, TypeError) as error:
        raise ExportError(f"The sidecar's episode_info cannot be used ({describe_error(error)}): {root}") from error


def dataset_problems(folder: LeRobotFolder) -> list[str]:
    """List missing, empty and truncated files, one sentence each; reads only the ends of files, which is fast.

    `demorec check` reads their whole content.
    """
    problems: list[str] = []
    places: Sequence[EpisodePlace] = ()
    with noted(problems, folder.root):
        places = folder.places
        problems += folder.notes
    for file, listed in folder.num_rows.items() if places else ():
        with noted(problems, folder.root):
            if (there := open_table(file).metadata.num_rows) != listed:
                raise ExportError(f"The data file has {there} rows, its episodes have {listed}: {file}")
    with noted(problems, folder.root):
        folder.tasks  # noqa: B018
    if not folder.info.is_old and not (folder.root / STATS_PATH).exists():
        problems.append(f"The statistics are missing: {STATS_PATH}")
    with noted(problems, folder.root):
        check_tables(folder.root)
    for video in sorted({video for place in places for video, _ in place.videos.values()}):
        with noted(problems, folder.root):
            check_video(video)
    return list(dict.fromkeys(problems))


def range_errors(folder: LeRobotFolder) -> Iterator[tuple[str, int, int, float | None]]:
    """Yield each range of rows or images in the table of episodes that does not fit the episode's length.

    Yields:
        Column of the range's end, number and length of the episode, and surplus frames; None for a missing column.
    """
    ranges = [("dataset_from_index", "dataset_to_index", 1)]
    for key in folder.info.video_keys:
        ranges.append((f"videos/{key}/from_timestamp", f"videos/{key}/to_timestamp", folder.info.fps))
    for path in folder.episode_tables:
        columns = open_table(path).schema_arrow.names
        for begin, end, unit in ranges:
            names = [begin, end] if end in columns else []
            for row in read_table(path, ["episode_index", "length", *names]).to_pylist():
                surplus = None if row.get(end) is None else (row[end] - row[begin]) * unit - row["length"]
                if surplus is None or not abs(surplus) < 0.5:
                    yield end, row["episode_index"], row["length"], surplus


@contextmanager
def noted(problems: list[str], root: Path) -> Iterator[None]:
    """Add an ExportError to the problems, without the dataset's own path. Lack of memory is not a problem of the
    dataset and is raised.
    """
    try:
        yield
    except ExportError as error:
        if (lack := resource_error(error)) is not None:
            raise lack from error
        problems.append(without_path(error, root).replace(f"{root}/", ""))


def without_digest(info: DatasetInfo) -> list[str]:
    """Features without a content digest: all except video, numbers and text, including text in language columns."""
    return [name for name, feature in info.features.items() if feature.dtype == "image"]


def check_tables(path: Path) -> None:
    """Read the ends of all tables and the JSON files to detect empty or truncated ones.

    Raises:
        ExportError: A file is empty or truncated.
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
    """SHA-256 (hex) of the content, read back from all files; equals `ExportReport.digest` of a new dataset.

    Raises:
        ExportError: The dataset is damaged.
    """
    folder = LeRobotFolder(path)
    return combined_digest(folder.info, episode_digests(folder))


def episode_digests(folder: LeRobotFolder, numbers: Sequence[int] | None = None) -> list[str]:
    """Compute the digests of some episodes, by default all, in order, from all files."""
    if unknown := without_digest(folder.info):
        raise ExportError(
            f"The content of {', '.join(unknown)} has no digest, because it is neither video nor numbers: {folder.root}"
        )
    rows = folder.rows(folder.columns)
    found: list[str] = []
    for place in folder.places if numbers is None else [folder.listed[number] for number in numbers]:
        columns = rows.numbers(place)
        task_index = columns["task_index"][0, 0] if len(columns["task_index"]) else -1
        if not 0 <= task_index < len(folder.tasks):  # NaN, the value of a null, is neither
            raise ExportError(f"Episode {place.episode_index} has no task: {folder.root}")
        found.append(episode_digest(folder.tasks[int(task_index)], columns, video_digests(folder, place)))
    return found


def video_digests(folder: LeRobotFolder, place: EpisodePlace) -> dict[str, str]:
    """SHA-256 (hex) of an episode's encoded images for each camera feature."""
    return {key: folder.video(key, place).digest() for key in folder.info.video_keys}

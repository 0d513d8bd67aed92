"""The episodes of a LeRobot dataset, whoever wrote it, as a report tells them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from demorec.errors import ConfigError, ExportError, in_words, without_path
from demorec.lerobot.attempts import ATTEMPT_SCHEMA
from demorec.lerobot.files import read_json, read_table
from demorec.lerobot.layout import DatasetInfo
from demorec.lerobot.paths import SIDECAR_DIR
from demorec.lerobot.reader import EpisodePlace, RowReader, episode_places
from demorec.lerobot.sidecar import CONFIGS_PATH, EPISODE_SCHEMA
from demorec.lerobot.stills import pictures_at
from demorec.report.content import Components, Filmstrip, PhaseSpan, ReportedEpisode
from demorec.report.filmstrip import filmstrip
from demorec.report.recorded import count
from demorec.scene.episode import SuccessCheck
from demorec.scene.features import ACTION, IMAGE_PREFIX, STATE
from demorec.scene.validity import read_episode_info

SUCCESS = "next.success"
_NUMBERS = ("float32", "float64", "int64", "bool")
_MOST_COMPONENTS = 64
"""Of one feature that are drawn."""
_OF_AN_EPISODE = (
    "episode_index", "source", "run_episode_index", "attempt", "root_seed", "success", "failure_phase",
    "failure_reason", "num_retries", "checks", "phases", "episode_info",
)  # fmt: skip
_OF_AN_ATTEMPT = ("run_episode_index", "attempt", "success", "failure_phase", "failure_reason", "in_dataset")


@dataclass(frozen=True, kw_only=True, eq=False)
class DatasetStory:
    """What stands beside a dataset of ours; empty for one of somebody else's.

    Attributes:
        rows: Number of the episode -> its row of the sidecar.
        left_out: Rows of attempts that are not in the dataset.
        configs: Config digest -> configuration.
    """

    rows: Mapping[int, Mapping[str, Any]]
    left_out: tuple[Mapping[str, Any], ...]
    configs: Mapping[str, Any]


def read_story(root: Path) -> DatasetStory:
    """What the sidecar tells.

    Raises:
        ExportError: It is damaged.
    """
    rows, seen = (
        [
            row
            for file in sorted((root / SIDECAR_DIR / name).glob("*/*.parquet"))
            for row in read_table(file, columns, schema=schema).to_pylist()
        ]
        for name, columns, schema in (
            ("episodes", _OF_AN_EPISODE, EPISODE_SCHEMA),
            ("attempts", _OF_AN_ATTEMPT, ATTEMPT_SCHEMA),
        )
    )
    try:
        configs = read_json(root / CONFIGS_PATH) if rows else {}
    except (OSError, ValueError) as error:
        raise ExportError(f"The sidecar's configs.json cannot be read ({in_words(error)}): {root}") from error
    return DatasetStory(
        rows={row["episode_index"]: row for row in rows},
        left_out=tuple(row for row in seen if not row["in_dataset"]),
        configs=configs if isinstance(configs, dict) else {},
    )


def camera_key(info: DatasetInfo, camera: str, root: Path) -> str | None:
    """The feature whose pictures are shown; None in a dataset without colour videos.

    Raises:
        ConfigError: There is no such camera.
    """
    keys = [key for key in info.video_keys if not info.features[key].is_depth]
    if not camera:
        return keys[0] if keys else None
    for key in keys:
        if camera in (key, key.removeprefix(IMAGE_PREFIX)):
            return key
    there = ", ".join(key.removeprefix(IMAGE_PREFIX) for key in keys) or "none"
    raise ConfigError(f"There is no camera {camera!r} with colour videos, the cameras are {there}: {root}")


def read_episodes(
    root: Path, info: DatasetInfo, story: DatasetStory, *, camera: str, strip_bytes: int, stride: int
) -> Iterator[tuple[ReportedEpisode, Components]]:
    """Every episode in order, its numbers counted, then the attempts that are in the sidecar and not in the dataset.

    Args:
        root: The dataset's folder.
        info: Of it.
        story: Of it.
        camera: Whose pictures the filmstrips show; "" for the first one.
        strip_bytes: How large each may be.
        stride: Every how manieth episode has one.

    Raises:
        ConfigError: There is no such camera.
        ExportError: The tables cannot be read.
    """
    key = camera_key(info, camera, root)
    wanted = {
        name: item
        for name, item in info.features.items()
        if name in (STATE, ACTION, SUCCESS) and item.dtype in _NUMBERS and len(item.shape) == 1
    }
    rows = RowReader(root, replace(info, features=wanted)) if wanted else None
    for number, place in enumerate(episode_places(root, info)):
        columns = {} if rows is None else rows.read(place)
        strip, problem = None, ""
        if key is not None and number % stride == 0:
            strip, problem = _strip(root, info, key, place, strip_bytes)
        episode = _episode(place, info.fps, columns, story.rows.get(place.episode_index))
        yield replace(episode, filmstrip=strip, problem=problem), _components(root, info, columns)
    for row in story.left_out:
        yield _left_out(row), {}


def _strip(
    root: Path, info: DatasetInfo, key: str, place: EpisodePlace, strip_bytes: int
) -> tuple[Filmstrip | None, str]:
    """The filmstrip, or why there is none."""
    try:
        strip = filmstrip(
            key.removeprefix(IMAGE_PREFIX),
            place.length,
            lambda frames: pictures_at(root, info, key, place, frames),
            most_bytes=strip_bytes,
        )
    except ExportError as error:
        return None, without_path(error, root)
    return strip, ""


def _episode(
    place: EpisodePlace, fps: int, columns: Mapping[str, NDArray[Any]], row: Mapping[str, Any] | None
) -> ReportedEpisode:
    name = f"episode {place.episode_index}"
    known = ReportedEpisode(name=name, instruction=", ".join(place.tasks), num_frames=place.length, fps=fps)
    if row is None:
        return replace(known, success=bool(columns[SUCCESS][-1, 0]) if len(columns.get(SUCCESS, ())) else None)
    if row["episode_info"] is None:  # collected: there is no scene, no seed and no phase
        source, reason = str(row["source"]), str(row["failure_reason"])
        return replace(known, source=source, success=row["success"], failure_reason=reason)
    try:
        return replace(
            known,
            source=row["source"],
            success=row["success"],
            failure_phase=row["failure_phase"],
            failure_reason=row["failure_reason"],
            num_retries=row["num_retries"],
            seed=row["root_seed"],
            phases=tuple(PhaseSpan(name=p["name"], first=p["from"], end=p["to"]) for p in row["phases"]),
            conditions=tuple(SuccessCheck(**check) for check in row["checks"]),
            info=read_episode_info(row["episode_info"]),
        )
    except (ValueError, KeyError, TypeError) as error:
        raise ExportError(f"The sidecar's row of {name} cannot be used ({in_words(error)})") from error


def _left_out(row: Mapping[str, Any]) -> ReportedEpisode:
    return ReportedEpisode(
        name=f"run's episode {row['run_episode_index']}, attempt {row['attempt']}",
        problem="This attempt is not in the dataset; how it ended is all that is known of it.",
        success=row["success"],
        failure_phase=row["failure_phase"] or "",
        failure_reason=row["failure_reason"] or "",
    )


def _components(root: Path, info: DatasetInfo, columns: Mapping[str, NDArray[Any]]) -> Components:
    found: Components = {}
    for feature in (STATE, ACTION):
        if feature not in columns:
            continue
        values = columns[feature]
        if values.dtype.kind not in "fiub":
            raise ExportError(f"The column {feature} holds something else than numbers: {root}")
        names = info.features[feature].names or ()
        if len(names) != values.shape[1]:
            names = tuple(f"component {number}" for number in range(values.shape[1]))
        count(found, feature, names[:_MOST_COMPONENTS], values)
    return found


def missing_in(root: Path, info: DatasetInfo, story: DatasetStory) -> Iterator[str]:
    """Sentences about what a dataset does not tell."""
    if not story.rows:
        yield (
            f"The dataset has no folder {SIDECAR_DIR}/, which exports of demorec have: scenes, random seeds, phases, "
            "the conditions of success and the coverage of the randomised ranges are not known."
        )
        if SUCCESS not in info.features:
            yield f"No column {SUCCESS} tells which episodes succeeded."
    if any(item.dtype == "image" for item in info.features.values()):
        yield "Its pictures lie as single images in the data files, which are not shown."
    elif camera_key(info, "", root) is None:
        yield "It has no colour videos, so there are no filmstrips."
    for feature in (STATE, ACTION):
        item = info.features.get(feature)
        if item is None:
            yield f"It has no column {feature}, so nothing of that is drawn."
        elif item.dtype not in _NUMBERS or len(item.shape) != 1:
            yield f"The column {feature} is no vector of numbers (dtype {item.dtype}), so nothing of it is drawn."
        elif item.shape[0] > _MOST_COMPONENTS:
            yield f"Of the {item.shape[0]} components of {feature} the first {_MOST_COMPONENTS} are drawn."

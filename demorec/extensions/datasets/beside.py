"""Files next to an edited dataset's tables, and the data of its sources that it omits.

These are the sidecar's rows and robots. Omissions are known before anything is written.
"""

from __future__ import annotations

import filecmp
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from demorec.core.errors import ExportError, describe_error
from demorec.core.plain import listed, parse_json, to_json
from demorec.datasets.lerobot.files import open_table, read_json
from demorec.datasets.lerobot.paths import BOXES_DIR, CARD_PATH, INFO_PATH, PROGRESS_PATH, is_dataset_file
from demorec.datasets.lerobot.sidecar import CONFIGS_PATH, EXPORT_PATH, EpisodeRecord
from demorec.extensions.datasets.dataset_features import MODALITY_PATH
from demorec.extensions.datasets.plan import EpisodeSlice, Plan

_OF_SCENE = ("root_seed", "config_digest", "final_state_digest", "objects", "episode_info")
"""Columns that describe a simulated episode as recorded, and do not apply to a cut one."""
_ABOUT_THE_WHOLE = (CARD_PATH, ".gitattributes", MODALITY_PATH)
"""Files that are copied if all sources have the same."""
_OF_ALL_ROWS = (f"{BOXES_DIR}/", PROGRESS_PATH, "meta/temporal_proportions_")
"""Files, or beginnings of their names, with values of all rows of the source."""
_OF_OTHER_TOOLS = (".cache/", ".git/")
"""Folders created by downloading a dataset."""
_COPIED = "copied"
MAX_NAMES = 5
"""Maximum files listed of one kind."""


def sidecar_record(plan: Plan, cut: EpisodeSlice) -> EpisodeRecord:
    """Return the sidecar's data about an episode of a plan. Raises ExportError if it cannot be read."""
    source = plan.sources[cut.source]
    row = source.sidecar_row(source.places[cut.episode].episode_index)
    row.setdefault("source", source.root.name)
    robot = row.get("robot_digest")
    if not plan.keeps_scene(cut):
        row |= dict.fromkeys(_OF_SCENE)
        row["phases"] = _cut_phases(row, cut)
    elif cut.task and row.get("episode_info") is not None:
        row["episode_info"] = _reworded(row["episode_info"], cut.task, source.root)
    if not cut.has_end:  # an outcome is unknown for a part of an episode
        row["success"] = None
    return EpisodeRecord(row=row, robot=None if robot is None else source.robot(str(robot)))


def kept_configs(plan: Plan) -> dict[str, Any] | None:
    """Return config digest -> configuration, of all sources; None if no source has a sidecar."""
    if not any(source.sidecar_tables for source in plan.sources):
        return None
    configs: dict[str, Any] = {}
    for source in plan.sources:
        if (source.root / CONFIGS_PATH).exists():
            configs |= read_json(source.root / CONFIGS_PATH)
    return configs


def kept_export(plan: Plan) -> Mapping[str, Any]:
    """Return the export options recorded by the first source that has any; empty if none has."""
    found = next((s.root for s in plan.sources if (s.root / EXPORT_PATH).exists()), None)
    return dict(read_json(found / EXPORT_PATH)) if found else {}


def _reworded(info: str, task: str, root: Path) -> str:
    """Description of a simulated episode with another instruction."""
    try:
        described = parse_json(info)
        described["instruction"] = task
    except (ValueError, TypeError) as error:
        raise ExportError(f"The sidecar's episode_info cannot be used ({describe_error(error)}): {root}") from error
    return to_json(described)


def _cut_phases(row: Mapping[str, Any], cut: EpisodeSlice) -> list[dict[str, Any]]:
    """Phases within a cut, with frames counted from its first one."""
    length = cut.last - cut.first
    return [
        {"name": phase["name"], "from": max(phase["from"] - cut.first, 0), "to": min(phase["to"] - cut.first, length)}
        for phase in row.get("phases") or ()
        if phase["from"] < cut.last and phase["to"] > cut.first
    ]


def left_out(plan: Plan) -> tuple[str, ...]:
    """One phrase for each omission with its reason in brackets, except the user's choices."""
    found: dict[str, set[str]] = {}
    for number in range(len(plan.sources)):
        for name, reason in (*_columns(plan, number), *_other_files(plan, number)):
            found.setdefault(reason, set()).add(name)
    found.pop(_COPIED, None)
    phrases = [f"{listed(sorted(names), MAX_NAMES, ', ')} ({reason})" for reason, names in found.items()]
    return (*phrases, *_scenes(plan), *_descriptions(plan), *_facts(plan))


def copied_files(plan: Plan) -> list[str]:
    """List the files that are copied unchanged: those about a whole dataset and unknown ones, equal in all sources."""
    return [name for name, reason in _other_files(plan, 0) if reason == _COPIED]


def copied_unchecked_files(plan: Plan) -> list[str]:
    """List the copied files that may not fit the result: unknown ones, and modality.json with names of features."""
    return [name for name in copied_files(plan) if name == MODALITY_PATH or name not in _ABOUT_THE_WHOLE]


def _columns(plan: Plan, number: int) -> Iterator[tuple[str, str]]:
    source = plan.sources[number]
    for path in filter(Path.exists, source.num_rows):
        for name in open_table(path).schema_arrow.names:
            if name not in source.info.features:
                yield name, f"{INFO_PATH} does not list this column of the data files"


def _other_files(plan: Plan, number: int) -> Iterator[tuple[str, str]]:
    """Yield (name, reason) of the files of a source that are not written anew: copied ones, and those left out."""
    source = plan.sources[number]
    used = {place.data for place in source.places}
    used |= {path for place in source.places for path, _ in place.videos.values()}
    for path in sorted(source.root.rglob("*")):
        name = path.relative_to(source.root).as_posix()
        if not path.is_file() or path in used or name.startswith(_OF_OTHER_TOOLS):
            continue
        is_unknown = not is_dataset_file(name)
        is_table = name.startswith(("data/", "meta/episodes/")) and path.suffix == ".parquet"
        if is_unknown and is_table:
            yield name, "LeRobot would read a copy as part of the dataset"
        elif is_unknown or name in _ABOUT_THE_WHOLE:
            is_same = not path.is_symlink() and all(_is_equal(path, other.root / name) for other in plan.sources)
            yield name, _COPIED if is_same else "not the same in all datasets: copy it if it still applies"
        elif name.startswith(("data/", "videos/", "images/")):
            yield name, "no episode of the dataset is in this file"
        elif name.startswith(_OF_ALL_ROWS):
            yield name, "its values hold for the episodes of the source"


def _is_equal(path: Path, other: Path) -> bool:
    return path == other or (other.is_file() and not other.is_symlink() and filecmp.cmp(path, other, shallow=False))


def _scenes(plan: Plan) -> Iterator[str]:
    changed = [cut for cut in plan.cuts if not plan.keeps_scene(cut)]
    lost = 0
    for number, source in enumerate(plan.sources if changed else ()):
        scenes = {row["episode_index"] for row in source.sidecar(["root_seed"]) if row["root_seed"] is not None}
        indices = {source.places[cut.episode].episode_index for cut in changed if cut.source == number}
        lost += len(indices & scenes)
    if lost:
        yield f"scenes of simulated episodes: {lost} (they describe the original episode)"


def _descriptions(plan: Plan) -> Iterator[str]:
    spoken = any(feature.dtype == "language" for feature in plan.info.features.values())
    if spoken and (count := sum(bool(cut.task) for cut in plan.cuts)):
        yield f"other wordings (task_aug) in episodes: {count} (they reword the old instruction)"


def _facts(plan: Plan) -> Iterator[str]:
    names = {name for source in plan.sources if not source.info.is_old for name in source.info.other}
    if lost := sorted(names - set(plan.info.other)):
        yield f"{', '.join(lost)} of info.json (the datasets differ)"

"""What stands beside the tables of an edited dataset: the sidecar's rows, robots, boxes; progress."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from demorec.datasets.editing.plan import Cut, Plan, Source
from demorec.datasets.lerobot.facts import PROGRESS_PATH, STAGE_COLUMNS, EpisodeProgress, write_progress
from demorec.datasets.lerobot.files import open_table, read_json, read_table
from demorec.datasets.lerobot.paths import SIDECAR_DIR, is_dataset_file
from demorec.datasets.lerobot.robots import read_robot
from demorec.datasets.lerobot.sidecar import (
    ATTEMPT_SCHEMA,
    CONFIGS_PATH,
    EPISODE_SCHEMA,
    EXPORT_PATH,
    EpisodeRecord,
    SidecarWriter,
)
from demorec.datasets.lerobot.writer import WrittenEpisode
from demorec.episode.features import ACTION, STATE

_OF_SCENE = ("root_seed", "config_digest", "final_state_digest", "objects", "goals", "episode_info")
"""What describes a simulated episode as it was recorded, and no longer holds for one that was cut or reworded."""


class Beside:
    """Context manager; `add` takes the episodes as they are written, `finish` completes the files."""

    def __init__(self, plan: Plan, folder: Path, aside: Path) -> None:
        self._plan, self._folder = plan, folder
        self._rows = [_by_episode(source, "episodes", EPISODE_SCHEMA.names) for source in plan.sources]
        self._attempts = [list(_attempts(source)) for source in plan.sources]
        limits: dict[str, Any] = {"limit_mb": plan.info.data_files_size_in_mb, "chunks_size": plan.info.chunks_size}
        configs: dict[str, Any] = {}
        for source in plan.sources:
            if (source.root / CONFIGS_PATH).exists():
                configs |= read_json(source.root / CONFIGS_PATH)
        has_any = any(source.has_sidecar for source in plan.sources)
        self._sidecar = SidecarWriter(folder, configs, **limits) if has_any else None
        stages = all(set(STAGE_COLUMNS) <= set(source.fact_types) for source in plan.sources)
        self._stages: list[Cut] | None = [] if stages else None

    def __enter__(self) -> Beside:
        return self

    def __exit__(self, *exc: object) -> None:
        if self._sidecar is not None:
            self._sidecar.__exit__(*exc)

    def add(self, cut: Cut, written: WrittenEpisode) -> None:
        """What belongs to an episode that was written."""
        if self._stages is not None:
            self._stages.append(cut)
        if self._sidecar is None:
            return
        source = self._plan.sources[cut.source]
        place = source.dataset.places[cut.episode]
        found = dict(self._rows[cut.source].get(place.episode_index, {}))
        digest = found.get("robot_digest")
        is_changed = (cut.first, cut.last) != (0, place.length) or bool(cut.task) or not self._is_described(cut.source)
        row = {name: value for name, value in found.items() if name not in ("episode_index", "content_digest")}
        row.setdefault("source", source.root.name)
        if is_changed:
            row |= dict.fromkeys(_OF_SCENE)
            row |= _cut_frames(row, cut)
        attempt = self._attempt(cut.source, row)
        record = EpisodeRecord(
            row=row,
            attempt=attempt,
            moving_cameras={},
            config_digest="",
            config={},
            robot=None if digest is None else read_robot(source.root, str(digest)),
        )
        self._sidecar.add(written, record)

    def _is_described(self, source: int) -> bool:
        """Whether states and actions are still those that the scene describes."""
        takes = self._plan.takes[source]
        return all(name not in self._plan.sources[source].info.features or (name in takes and takes[name].is_copy
                   and takes[name].feature == name) for name in (STATE, ACTION))  # fmt: skip

    def _attempt(self, source: int, row: dict[str, Any]) -> dict[str, Any]:
        names = ("source", "run_episode_index", "attempt")
        for attempt in self._attempts[source]:
            if all(attempt[name] == row.get(name) for name in names):
                return {name: value for name, value in attempt.items() if name != "in_dataset"}
        return {name: row.get(name) for name in ATTEMPT_SCHEMA.names if name != "in_dataset"}

    def finish(self) -> tuple[str, ...]:
        """Complete the files; return those of the sources that were not taken over."""
        if self._sidecar is not None:
            found = next((s.root for s in self._plan.sources if (s.root / EXPORT_PATH).exists()), None)
            self._sidecar.finish(read_json(found / EXPORT_PATH) if found else {})
        if self._stages is not None and all((s.root / PROGRESS_PATH).exists() for s in self._plan.sources):
            write_progress(self._folder, [EpisodeProgress.from_row(row, goals) for row, goals in self._stage_rows()])
        return tuple(sorted({name for source in self._plan.sources for name in self._left_out(source)}))

    def _stage_rows(self) -> Iterator[tuple[dict[str, Any], int]]:
        for path in sorted((self._folder / "meta" / "episodes").glob("*/*.parquet")):
            for row in read_table(path, [*STAGE_COLUMNS, "num_goals"]).to_pylist():
                yield row, int(row["num_goals"])

    def _left_out(self, source: Source) -> Iterator[str]:
        for path in source.root.rglob("*"):
            name = path.relative_to(source.root).as_posix()
            if not path.is_file() or name.startswith(".cache/"):
                continue
            if (
                name.startswith((f"{SIDECAR_DIR}/camera_poses/", f"{SIDECAR_DIR}/boxes/"))
                or (name == PROGRESS_PATH and not (self._folder / name).exists())
                or not is_dataset_file(name)
            ):
                yield name


def _by_episode(source: Source, table: str, names: list[str]) -> dict[int, dict[str, Any]]:
    found: dict[int, dict[str, Any]] = {}
    for path in sorted((source.root / SIDECAR_DIR / table).glob("*/*.parquet")):
        there = [name for name in names if name in open_table(path).schema_arrow.names]
        found |= {row["episode_index"]: row for row in read_table(path, there).to_pylist()}
    return found


def _attempts(source: Source) -> Iterator[dict[str, Any]]:
    for path in sorted((source.root / SIDECAR_DIR / "attempts").glob("*/*.parquet")):
        yield from read_table(path, ATTEMPT_SCHEMA.names).to_pylist()


def _cut_frames(row: dict[str, Any], cut: Cut) -> dict[str, Any]:
    """Phases and misses within a cut, frames counted from its first one."""
    length = cut.last - cut.first
    phases = [
        {"name": phase["name"], "from": max(phase["from"] - cut.first, 0), "to": min(phase["to"] - cut.first, length)}
        for phase in row.get("phases") or ()
        if phase["from"] < cut.last and phase["to"] > cut.first
    ]
    misses = [frame - cut.first for frame in row.get("deliberate_miss_frames") or () if cut.first <= frame < cut.last]
    return {"phases": phases, "deliberate_miss_frames": misses}

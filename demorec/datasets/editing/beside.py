"""What stands beside the tables of an edited dataset: the sidecar's rows, robots, attempts, poses, boxes, progress."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from demorec.core.errors import ExportError, in_words
from demorec.core.plain import parse_json, to_json
from demorec.datasets.editing.carried import (
    Boxes,
    CameraPoses,
    poses_are_kept,
    progress_is_kept,
    write_kept_progress,
)
from demorec.datasets.editing.plan import Cut, Plan
from demorec.datasets.lerobot.files import read_json
from demorec.datasets.lerobot.reader import EpisodeRows
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

_OF_SCENE = ("root_seed", "config_digest", "final_state_digest", "objects", "goals", "episode_info")
"""What describes a simulated episode as it was recorded, and no longer holds for one that was cut."""


class Beside:
    """Context manager; `add` takes the episodes as they are written, `finish` completes the files.

    Args:
        plan: What is written.
        folder: Of the new dataset.
    """

    def __init__(self, plan: Plan, folder: Path) -> None:
        self._plan, self._folder = plan, folder
        limits: dict[str, Any] = {"limit_mb": plan.info.data_files_size_in_mb, "chunks_size": plan.info.chunks_size}
        configs: dict[str, Any] = {}
        for source in plan.sources:
            if (source.root / CONFIGS_PATH).exists():
                configs |= read_json(source.root / CONFIGS_PATH)
        has_any = any(source.sidecar_tables for source in plan.sources)
        self._sidecar = SidecarWriter(folder, configs, **limits) if has_any else None
        sources = plan.sources if has_any else ()
        self._rows = [EpisodeRows(source.sidecar_tables, EPISODE_SCHEMA, rows=64) for source in sources]
        self._poses = [CameraPoses(source) for source in (sources if poses_are_kept(plan) else ())]
        self._boxes = Boxes(plan, folder)

    def __enter__(self) -> Beside:
        return self

    def __exit__(self, *exc: object) -> None:
        self._boxes.close()
        if self._sidecar is not None:
            self._sidecar.__exit__(*exc)

    def add(self, cut: Cut, written: WrittenEpisode) -> None:
        """What belongs to an episode that was written."""
        self._boxes.add(written.episode_index, cut)
        if self._sidecar is None:
            return
        source = self._plan.sources[cut.source]
        index = source.places[cut.episode].episode_index
        table = self._rows[cut.source].read(index)
        found: dict[str, Any] = {} if table is None else table.to_pylist()[-1]
        digest = found.get("robot_digest")
        row = {name: value for name, value in found.items() if name not in ("episode_index", "content_digest")}
        row.setdefault("source", source.root.name)
        if not self._plan.keeps_scene(cut):
            row |= dict.fromkeys(_OF_SCENE)
            row |= _cut_frames(row, cut)
        elif cut.task and row.get("episode_info") is not None:
            row["episode_info"] = _reworded(row["episode_info"], cut.task, source.root)
        attempts = source.attempts
        for attempt in attempts.failed(index):
            self._sidecar.add_attempt(attempt, in_dataset=False)
        attempt = attempts.of(index) or {name: row.get(name) for name in ATTEMPT_SCHEMA.names if name != "in_dataset"}
        record = EpisodeRecord(
            row=row,
            moving_cameras=self._poses[cut.source].of(index, cut) if self._poses else {},
            config_digest="",
            config={},
            robot=None if digest is None else read_robot(source.root, str(digest)),
        )
        self._sidecar.add(written, record, attempt)

    def finish(self) -> None:
        """Complete the files."""
        self._boxes.finish()
        if self._sidecar is not None:
            for number, source in enumerate(self._plan.sources):
                for attempt in source.attempts.homeless() if self._plan.takes_all_of(number) else ():
                    self._sidecar.add_attempt(attempt, in_dataset=False)
            found = next((s.root for s in self._plan.sources if (s.root / EXPORT_PATH).exists()), None)
            self._sidecar.finish(read_json(found / EXPORT_PATH) if found else {})
        if progress_is_kept(self._plan):
            write_kept_progress(self._plan, self._folder)


def _reworded(info: str, task: str, root: Path) -> str:
    """The description of a simulated episode with another instruction."""
    try:
        described = parse_json(info)
        described["instruction"] = task
    except (ValueError, TypeError) as error:
        raise ExportError(f"The sidecar's episode_info cannot be used ({in_words(error)}): {root}") from error
    return to_json(described)


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

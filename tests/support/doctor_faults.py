"""Faults that the checks of datasets must find, one at a time. They were written down before the checks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from support import doctor_damage as rows
from support import doctor_file_damage as files
from support.doctor_bases import DatasetBase
from support.doctor_damage import RowFault
from support.doctor_file_damage import FileFault


@dataclass(frozen=True, kw_only=True)
class PlantedFault:
    """A fault.

    Attributes:
        rows, files: Functions that spoil an episode before or after it is written.
        is_harmful: Whether training on it is wrong or impossible.
        is_whole: Whether all episodes have it, so that none needs to be named.
        needs: Trait that the base must have.
    """

    rows: RowFault | None = None
    files: FileFault | None = None
    is_harmful: bool = True
    is_whole: bool = False
    needs: str = ""

    def applies(self, base: DatasetBase) -> bool:
        """Whether a base can have the fault."""
        traits = {"", base.version, "delta" if base.is_delta else "absolute", *base.features}
        traits |= {f"{count} cameras" for count in range(1, len(base.cameras) + 1)}
        return self.needs in traits


def _one(spoil: RowFault, needs: str = "", *, is_harmful: bool = True) -> PlantedFault:
    return PlantedFault(rows=spoil, needs=needs, is_harmful=is_harmful)


def _all(spoil: RowFault, needs: str = "", *, is_harmful: bool = True) -> PlantedFault:
    return PlantedFault(rows=spoil, needs=needs, is_harmful=is_harmful, is_whole=True)


def _files(spoil: FileFault, needs: str = "", *, is_harmful: bool = True, is_whole: bool = True) -> PlantedFault:
    return PlantedFault(files=spoil, needs=needs, is_harmful=is_harmful, is_whole=is_whole)


VELOCITY, POSE = "observation.velocity", "observation.ee_pose"
CAMERA, CAMERAS = "1 cameras", "2 cameras"

FAULTS: dict[str, PlantedFault] = {
    "data cut short": _files(files.cut(files.data_file, 0.7)),
    "never finalized": _files(files.unlinked(files.episode_table)),
    "info cut short": _files(files.cut(lambda root, _: root / "meta/info.json", 0.5)),
    "total of frames": _files(files.json_file("meta/info.json", lambda info: info.update(total_frames=7))),
    "length of an episode": _files(
        files.episode_row(lambda row, _: row.update(length=row["length"] - 9)), is_whole=False
    ),
    "rows of the next episode": _files(
        files.episode_row(lambda row, after: row.update({name: after[name] for name in files.RANGE})),
        "v3.0",
        is_whole=False,
    ),
    "video cut short": _files(files.cut(files.video_file, 0.6), CAMERA),
    "video that does not decode": _files(files.noisy_video, CAMERA),
    "video shorter than the rows": _files(files.short_video, CAMERA),
    "video missing": _files(files.unlinked(files.video_file), CAMERA),
    "another codec": _files(files.camera_info({"video.codec": "av1"}), CAMERA, is_harmful=False),
    "another size": _files(files.camera_info({"video.width": 640, "video.height": 480}), CAMERA, is_harmful=False),
    "stray table": _files(files.stray),
    "stray video": _files(files.stray_video, CAMERA, is_harmful=False),
    "frame numbers": _files(files.data_column("frame_index", files.restarted), is_whole=False),
    "row numbers": _files(files.data_column("index", files.restarted), is_whole=False),
    "instruction of another task": _files(files.data_column("task_index", files.another_task), is_whole=False),
    "no such task": _files(files.data_column("task_index", files.no_such_task), is_whole=False),
    "deviation of the state": _files(files.statistics("state", "std", 3.0)),
    "mean of the action": _files(files.statistics("action", "mean", 1.0)),
    "maximum of the state": _files(files.statistics("state", "max", 1.5)),
    "tasks' statistics": _files(files.statistics("task_index", "mean", 2.0), is_harmful=False),
    "gap": _one(rows.time(lambda t: t + (np.arange(len(t)) > len(t) // 2))),
    "dropped rows": _one(rows.dropped_rows(regular=False)),
    "dropped rows without a gap": _one(rows.dropped_rows(regular=True)),
    "doubled stamps": _one(rows.time(lambda t: t[np.arange(len(t)) - (np.arange(len(t)) % 7 == 6)])),
    "stamps go back": _one(rows.time(lambda t: np.where(np.arange(len(t)) == len(t) // 2, t - 0.7, t))),
    "another rate": _one(rows.time(lambda t: t * 1.2)),
    "another rate in all": _all(rows.time(lambda t: t * 2, whole=True)),
    "old samples": _one(rows.on("state", rows.held), is_harmful=False),
    "stuck state": _one(rows.on("state", rows.stuck)),
    "NaN": _one(rows.on("state", rows.put(np.nan, slice(20, 21)))),
    "infinity": _one(rows.on("action", rows.put(np.inf, slice(30, 33)))),
    "beyond limits": _one(rows.on("state", rows.beyond)),
    "spike": _one(rows.on("state", rows.spiked)),
    "encoder slip": _one(rows.on("state", rows.slipped)),
    "unit of an episode": _one(rows.both(rows.other_unit)),
    "unit of the state": _all(rows.on("state", rows.other_unit, whole=True), "absolute"),
    "unit of the gripper": _one(rows.on("state", rows.gripper(0, lambda g: g * 100))),
    "velocity in degrees": _one(rows.on(VELOCITY, lambda v, _: v * 57.3), VELOCITY),
    "velocity inverted": _one(rows.on(VELOCITY, lambda v, _: -v), VELOCITY),
    "pose in millimetres": _one(rows.on(POSE, lambda v, _: v * ([1000] * 3 + [1] * 4)), POSE),
    "pose of another tool": _one(rows.on(POSE, lambda v, _: v + np.eye(7)[2] * 0.08), POSE),
    "quaternion not a unit": _one(rows.on("state", lambda v, _: v * ([1] * 3 + [0.7] * 4 + [1])), "delta"),
    "quaternion flips": _one(rows.on("state", rows.quaternion_flips), "delta"),
    "quaternion w first": _one(rows.on("state", lambda v, _: v[:, [0, 1, 2, 6, 3, 4, 5, 7]]), "delta"),
    "dead joint": _one(rows.on("state", lambda v, _: np.where(np.arange(v.shape[1]) == 1, v[0], v))),
    "dead joint in all": _all(rows.on("state", lambda v, _: np.where(np.arange(v.shape[1]) == 1, 0.5, v), whole=True)),
    "dead action in all": _all(rows.on("action", lambda v, _: np.where(np.arange(v.shape[1]) == 1, 0, v), whole=True)),
    "action late": _one(rows.on("action", rows.shifted(0.6))),
    "action early": _one(rows.on("action", rows.shifted(-0.6))),
    "action a frame late": _one(rows.on("action", rows.shifted(0, frames=1)), "absolute", is_harmful=False),
    "action late in all": _all(rows.on("action", rows.shifted(0.6), whole=True)),
    "action equal to the state": _one(rows.equal_to_state(whole=False), "absolute"),
    "action equal in all": _all(rows.equal_to_state(whole=True), "absolute"),
    "action of another episode": _one(rows.other_action),
    "exchanged elements": _one(rows.on("action", rows.exchanged)),
    "exchanged elements in all": _all(rows.on("action", rows.exchanged, whole=True)),
    "inverted gripper": _one(rows.on("action", rows.gripper(1, rows.turned_round))),
    "inverted gripper in all": _all(rows.on("action", rows.gripper(1, rows.turned_round), whole=True), "absolute"),
    "unfollowed gripper": _one(rows.on("state", rows.gripper(0, lambda g: g[0]))),
    "black": _one(rows.shown(np.zeros_like), CAMERA),
    "frozen": _one(rows.shown(rows.frozen(1.0)), CAMERA),
    "frozen for a third": _one(rows.shown(rows.frozen(0.35)), CAMERA),
    "slower camera": _one(rows.shown(rows.third_rate), CAMERA, is_harmful=False),
    "slower camera in all": _all(rows.shown(rows.third_rate, whole=True), CAMERA, is_harmful=False),
    "covered": _one(rows.shown(rows.covered), CAMERA),
    "exchanged cameras": _one(rows.exchange_cameras, CAMERAS),
    "doubled camera": _one(rows.double_camera(whole=False), CAMERAS),
    "doubled camera in all": _all(rows.double_camera(whole=True), CAMERAS),
    "turned camera": _one(rows.shown(lambda v: v[:, ::-1, ::-1]), CAMERA),
    "images of another take": _one(rows.other_take, CAMERA),
    "images late": _one(rows.shown(rows.late), CAMERA),
    "images late in all": _all(rows.shown(rows.late, whole=True), CAMERA),
    "copy": _one(rows.copies(1)),
    "four copies": _one(rows.copies(1, 2, 3)),
    "shared piece": _one(rows.shared_piece),
    "cut off": _one(rows.spoilt("cut off")),
    "never ended": _one(rows.two_in_one),
    "idle beginning": _one(rows.idle(0.0, 5), is_harmful=False),
    "idle end": _one(rows.idle(1.0, 5), is_harmful=False),
    "pause": _one(rows.idle(0.5, 4), is_harmful=False),
    "slow": _one(rows.spoilt("slow"), is_harmful=False),
    "detour": _one(rows.spoilt("detour"), is_harmful=False),
    "jerky": _one(rows.spoilt("jerky"), is_harmful=False),
    "task with one episode": _one(rows.task("Wipe the table with the sponge"), is_harmful=False),
    "empty instruction": _one(rows.task("")),
}
"""Faults by name; `benchmarks/doctor_faults.py` also lets two sets share an episode."""

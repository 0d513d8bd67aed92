"""Faults that the checks of datasets must find, one at a time.

The words of each fault come from the requirements, and predate the checks.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from support import doctor_damage as rows
from support import doctor_file_damage as files
from support.doctor_bases import DatasetBase
from support.doctor_damage import RowFault
from support.doctor_file_damage import FileFault


@dataclass(frozen=True, kw_only=True)
class PlantedFault:
    """A fault and the checks that may find it.

    Attributes:
        family: Family of checks.
        words: Parts of check names that are accepted, separated by spaces.
        rows, files: Functions that spoil an episode before or after it is written.
        is_harmful: Whether training on it is wrong or impossible.
        is_whole: Whether all episodes have it, so that none needs to be named.
        needs: Trait that the base must have (`traits`).
    """

    family: str
    words: str
    rows: RowFault | None = None
    files: FileFault | None = None
    is_harmful: bool = True
    is_whole: bool = False
    needs: str = ""


def traits(base: DatasetBase) -> set[str]:
    """Traits of a base that faults may require."""
    found = {base.version, "delta" if base.is_delta else "absolute"}
    found |= {"camera"} if base.cameras else set()
    found |= {"two cameras"} if len(base.cameras) > 1 else set()
    found |= {"velocity"} if "observation.velocity" in base.features else set()
    found |= {"pose"} if "observation.ee_pose" in base.features else set()
    return found


def applies(fault: PlantedFault, base: DatasetBase) -> bool:
    """Whether a base can have the fault."""
    return not fault.needs or fault.needs in traits(base)


OPENS = "open file read damag parquet final footer missing whole complete count rows decode video meta index"
COUNTS = "count index indices meta rows length total info episode table open file"
VIDEO = "video decode image open file crc frame count length rows short missing"
TIME = "time stamp gap drop clock rate fps sampl doubl monoton regular interval"
JUMPS = "jump step speed spike gap skip drop outlier unusual discontinu teleport veloc slip smooth"
RANGE = "limit range beyond outlier unusual unit scale jump extreme bound spike speed"
UNITS = "unit scale range degree limit outlier unusual beyond"
STALE = "old stale held hold repeat frozen sampl stuck dead rate duplic still constant"
ALIGNED = "align late lag early shift offset delay sync follow action track lead"
COMMANDS = "equal same copy action exchang swap permut order channel element follow align match track mix"
GRIPPER = "gripper hand grip invert follow align"
DEAD = "dead constant frozen stuck still element channel follow zero align"
IMAGES = "image frozen blank camera black dark cover occlu contrast freeze repeat still duplic video"
CAMERAS = "camera exchang swap doubl duplic same image view turn rotat flip other take outlier unusual match"
SYNC = "image video camera sync offset late shift lag align take other match"
COPIES = "cop duplic same shared overlap repeat"
IDLE = "idle pause rest still static stop wait length outlier unusual hesit score"
OUTLIER = "outlier unusual length long path jerk slow score smooth speed end cut idle pause incomplete truncat unfinish"
LANGUAGE = "instruct task language text empty contradict meta label"
POSES = "pose kinematic quaternion unit range scale jump norm orientation flip outlier unusual limit forward"
VELOCITIES = "veloc differ deriv unit scale speed"
STATISTICS = "statistic"


def _rows(family: str, words: str, spoil: RowFault, **more: object) -> PlantedFault:
    return PlantedFault(family=family, words=words, rows=spoil, **more)  # type: ignore[arg-type]


_time, _number = partial(_rows, "time"), partial(_rows, "numbers")
_alignment, _image, _set = partial(_rows, "alignment"), partial(_rows, "images"), partial(_rows, "set")


def _files(words: str, spoil: FileFault, **more: object) -> PlantedFault:
    return PlantedFault(**{"family": "files", "words": words, "files": spoil, "is_whole": True, **more})  # type: ignore[arg-type]


_FILES = {
    "data cut short": _files(OPENS, files.cut(files.data_file, 0.7)),
    "never finalized": _files(OPENS, files.unlinked(files.episode_table)),
    "info cut short": _files(OPENS, files.cut(lambda root, _: root / "meta/info.json", 0.5)),
    "total of frames": _files(COUNTS, files.json_file("meta/info.json", lambda info: info.update(total_frames=7))),
    "length of an episode": _files(
        COUNTS, files.episode_row(lambda row, _: row.update(length=row["length"] - 9)), is_whole=False
    ),
    "rows of the next episode": _files(
        COUNTS,
        files.episode_row(
            lambda row, after: row.update(
                dataset_from_index=after["dataset_from_index"], dataset_to_index=after["dataset_to_index"]
            )
        ),
        needs="v3.0",
        is_whole=False,
    ),
    "video cut short": _files(VIDEO, files.cut(files.video_file, 0.6), needs="camera"),
    "video that does not decode": _files(VIDEO, files.noisy_video, needs="camera"),
    "video shorter than the rows": _files(VIDEO, files.short_video, needs="camera"),
    "video missing": _files(VIDEO, files.unlinked(files.video_file), needs="camera"),
    "another codec": _files(
        VIDEO + " codec info", files.camera_info({"video.codec": "av1"}), needs="camera", is_harmful=False
    ),
    "another size": _files(
        VIDEO + " size shape info",
        files.camera_info({"video.width": 640, "video.height": 480}),
        needs="camera",
        is_harmful=False,
    ),
    "stray table": _files(OPENS + " stray unrefer extra orphan refer unused", files.stray),
    "stray video": _files(
        "stray unrefer extra orphan refer unused file", files.stray_video, needs="camera", is_harmful=False
    ),
    "frame numbers": _files(COUNTS + " frame", files.data_column("frame_index", files.restarted), is_whole=False),
    "row numbers": _files(COUNTS, files.data_column("index", files.restarted), is_whole=False),
}

_TIME = {
    "gap": _time(TIME, rows.time(lambda t, _: t + (np.arange(len(t)) > len(t) // 2))),
    "dropped rows": _time(TIME, rows.dropped_rows(regular=False)),
    "dropped rows without a gap": _time(TIME + " " + JUMPS, rows.dropped_rows(regular=True)),
    "doubled stamps": _time(TIME, rows.time(lambda t, _: t[np.arange(len(t)) - (np.arange(len(t)) % 7 == 6)])),
    "stamps go back": _time(TIME, rows.time(lambda t, _: np.where(np.arange(len(t)) == len(t) // 2, t - 0.7, t))),
    "another rate": _time(TIME, rows.time(lambda t, _: t * 1.2)),
    "another rate in all": _time(TIME, rows.time(lambda t, _: t * 2, whole=True), is_whole=True),
    "old samples": _time(STALE, rows.on("state", rows.held), is_harmful=False),
    "stuck state": _time(STALE + " " + ALIGNED, rows.on("state", rows.stuck)),
}

_NUMBERS = {
    "NaN": _number("nan finite number missing", rows.on("state", rows.put(np.nan, slice(20, 21)))),
    "infinity": _number("nan finite inf number", rows.on("action", rows.put(np.inf, slice(30, 33)))),
    "beyond limits": _number(RANGE, rows.on("state", rows.beyond)),
    "spike": _number(JUMPS, rows.on("state", rows.spiked)),
    "encoder slip": _number(JUMPS + " " + ALIGNED, rows.on("state", rows.slipped)),
    "unit of an episode": _number(UNITS, rows.both(rows.other_unit)),
    "unit of the state": _number(
        UNITS + " " + ALIGNED, rows.on("state", rows.other_unit, whole=True), is_whole=True, needs="absolute"
    ),
    "unit of the gripper": _number(UNITS + " gripper", rows.on("state", rows.gripper(0, lambda g: g * 100))),
    "velocity in degrees": _number(
        VELOCITIES, rows.on("observation.velocity", lambda v, _: v * 57.3), needs="velocity"
    ),
    "velocity inverted": _number(VELOCITIES, rows.on("observation.velocity", lambda v, _: -v), needs="velocity"),
    "pose in millimetres": _number(
        POSES, rows.on("observation.ee_pose", lambda v, _: rows.columns_of(v, 0, 3, 1000)), needs="pose"
    ),
    "pose of another tool": _number(
        POSES, rows.on("observation.ee_pose", lambda v, _: v + np.eye(7)[2] * 0.08), needs="pose"
    ),
    "quaternion not a unit": _number(
        POSES, rows.on("state", lambda v, _: rows.columns_of(v, 3, 4, 0.7)), needs="delta"
    ),
    "quaternion flips": _number(POSES, rows.on("state", rows.quaternion_flips), needs="delta"),
    "quaternion w first": _number(POSES, rows.on("state", rows.w_first), needs="delta"),
    "dead joint": _number(DEAD, rows.on("state", lambda v, _: np.where(np.arange(v.shape[1]) == 1, v[0], v))),
    "dead joint in all": _number(
        DEAD, rows.on("state", lambda v, _: np.where(np.arange(v.shape[1]) == 1, 0.5, v), whole=True), is_whole=True
    ),
    "dead action in all": _number(
        DEAD, rows.on("action", lambda v, _: np.where(np.arange(v.shape[1]) == 1, 0, v), whole=True), is_whole=True
    ),
    "deviation of the state": _files(STATISTICS, files.statistics("state", "std", 3.0)),
    "mean of the action": _files(STATISTICS, files.statistics("action", "mean", 1.0)),
    "maximum of the state": _files(STATISTICS, files.statistics("state", "max", 1.5)),
    "tasks' statistics": _files(STATISTICS, files.statistics("task_index", "mean", 2.0), is_harmful=False),
}

_ALIGNMENT = {
    "action late": _alignment(ALIGNED, rows.on("action", rows.shifted(0.6))),
    "action early": _alignment(ALIGNED, rows.on("action", rows.shifted(-0.6))),
    "action a frame late": _alignment(
        ALIGNED, rows.on("action", rows.shifted(0, frames=1)), is_harmful=False, needs="absolute"
    ),
    "action late in all": _alignment(ALIGNED, rows.on("action", rows.shifted(0.6), whole=True), is_whole=True),
    "action equal to the state": _alignment(COMMANDS, rows.equal_to_state(whole=False), needs="absolute"),
    "action equal in all": _alignment(COMMANDS, rows.equal_to_state(whole=True), is_whole=True, needs="absolute"),
    "exchanged elements": _alignment(COMMANDS, rows.on("action", rows.exchanged)),
    "exchanged elements in all": _alignment(COMMANDS, rows.on("action", rows.exchanged, whole=True), is_whole=True),
    "inverted gripper": _alignment(GRIPPER, rows.on("action", rows.gripper(1, rows.turned_round))),
    "inverted gripper in all": _alignment(
        GRIPPER, rows.on("action", rows.gripper(1, rows.turned_round), whole=True), is_whole=True, needs="absolute"
    ),
    "unfollowed gripper": _alignment(GRIPPER + " " + DEAD, rows.on("state", rows.gripper(0, lambda g: g[0]))),
}

_IMAGES = {
    "black": _image(IMAGES, rows.shown(np.zeros_like), needs="camera"),
    "frozen": _image(IMAGES, rows.shown(rows.frozen(1.0)), needs="camera"),
    "frozen for a third": _image(IMAGES, rows.shown(rows.frozen(0.35)), needs="camera"),
    "slower camera": _image(
        IMAGES + " rate slow", rows.shown(lambda v: v[np.arange(len(v)) // 3 * 3]), needs="camera", is_harmful=False
    ),
    "slower camera in all": _image(
        IMAGES + " rate slow",
        rows.shown(lambda v: v[np.arange(len(v)) // 3 * 3], whole=True),
        needs="camera",
        is_whole=True,
        is_harmful=False,
    ),
    "covered": _image(IMAGES, rows.shown(rows.covered), needs="camera"),
    "exchanged cameras": _image(CAMERAS, rows.exchange_cameras, needs="two cameras"),
    "doubled camera": _image(CAMERAS, rows.double_camera(whole=False), needs="two cameras"),
    "doubled camera in all": _image(CAMERAS, rows.double_camera(whole=True), needs="two cameras", is_whole=True),
    "turned camera": _image(CAMERAS, rows.shown(lambda v: v[:, ::-1, ::-1]), needs="camera"),
    "images of another take": _image(SYNC, rows.other_take, needs="camera"),
    "images late": _time(SYNC, rows.shown(lambda v: v[np.maximum(np.arange(len(v)) - len(v) // 6, 0)]), needs="camera"),
    "images late in all": _time(
        SYNC,
        rows.shown(lambda v: v[np.maximum(np.arange(len(v)) - len(v) // 6, 0)], whole=True),
        needs="camera",
        is_whole=True,
    ),
}

_SET = {
    "copy": _set(COPIES, rows.copies(1)),
    "four copies": _set(COPIES, rows.copies(1, 2, 3)),
    "shared piece": _set(COPIES, rows.shared_piece),
    "cut off": _set(OUTLIER, rows.spoilt("cut off")),
    "never ended": _set(OUTLIER + " " + JUMPS, rows.two_in_one),
    "idle beginning": _set(IDLE, rows.idle(0.0, 5), is_harmful=False),
    "idle end": _set(IDLE, rows.idle(1.0, 5), is_harmful=False),
    "pause": _set(IDLE, rows.idle(0.5, 4), is_harmful=False),
    "slow": _set(OUTLIER, rows.spoilt("slow"), is_harmful=False),
    "detour": _set(OUTLIER, rows.spoilt("detour"), is_harmful=False),
    "jerky": _set(OUTLIER, rows.spoilt("jerky"), is_harmful=False),
    "task with one episode": _set(
        LANGUAGE + " coverage balance few single", rows.task("Wipe the table with the sponge"), is_harmful=False
    ),
    "empty instruction": _set(LANGUAGE, rows.task("")),
    "instruction of another task": _files(
        LANGUAGE + " count index", files.data_column("task_index", files.another_task), family="set", is_whole=False
    ),
    "no such task": _files(
        LANGUAGE + " count index", files.data_column("task_index", files.no_such_task), family="set", is_whole=False
    ),
}

FAULTS: dict[str, PlantedFault] = {**_FILES, **_TIME, **_NUMBERS, **_ALIGNMENT, **_IMAGES, **_SET}
"""Faults by name; `benchmarks/doctor_faults.py` plants `leakage` between two sets."""

"""Faults in tables, files, words and sidecar of LeRobot datasets, for `dataset_faults.py`.

The order is fixed: every second fault belongs to the half that was never looked at when laws were written.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

from support import loose
from support.dataset_edits import (
    FRONT,
    WRIST,
    Fault,
    at,
    cells,
    cut,
    hole,
    info,
    numbers,
    of_json,
    on_disk,
    pointer,
    said,
    spoken,
    stats,
    swap,
    table,
)
from support.dataset_particular import (
    both_tables,
    exchange,
    exchanged_files,
    exchanged_films,
    exchanged_paths,
    first_subtask,
    heavier,
    one_file_for_both,
    other_camera,
    other_measure,
    other_tcp,
    phases_late,
    points,
    range_late,
    renamed,
    stats_mean_of_means,
    stats_of_first,
    turned_mount,
)

STATE, VELOCITY, EFFORT, POSE = (f"observation.{name}" for name in ("state", "velocity", "effort", "ee_pose"))
ACTION, WORLD, EPISODES, KNOWN = "action", "observation.environment_state", "meta/episodes", "demorec/episodes"

META: tuple[tuple[str, Fault], ...] = (
    (
        "texts of two tasks exchanged",
        table("meta/tasks.parquet", lambda t: loose.replaced(t, "task", swap(t.column("task").to_pylist()))),
    ),
    (
        "a task that no row has",
        table(
            "meta/tasks.parquet",
            lambda t: pa.concat_tables(
                [t, loose.replaced(loose.replaced(t.slice(0, 1), "task", ["fold it"]), "task_index", [t.num_rows])]
            ),
        ),
    ),
    ("a task twice", cells("meta/tasks.parquet", "task", lambda v: [v[-1], *v[1:]])),
    ("a task's number twice", cells("meta/tasks.parquet", "task_index", lambda v: [v[-1], *v[1:]])),
    ("a task without words", cells("meta/tasks.parquet", "task", at(0, lambda v: ""))),
    ("a placeholder as task", both_tables("TODO")),
    ("tasks numbered from 1", cells("meta/tasks.parquet", "task_index", lambda v: [n + 1 for n in v])),
    ("tasks of two episodes exchanged", cells(EPISODES, "tasks", lambda v: [v[-1], *v[1:-1], v[0]])),
    ("an episode without tasks", cells(EPISODES, "tasks", at(1, lambda v: []))),
    ("a length that is off by one", cells(EPISODES, "length", at(1, lambda v: v - 1))),
    ("first rows of two episodes exchanged", cells(EPISODES, "dataset_from_index", swap)),
    ("first rows of files, not of the dataset", cells(EPISODES, "dataset_from_index", lambda v: [0 for _ in v])),
    ("episodes in another order", table(EPISODES, lambda t: t.take(pa.array(np.arange(t.num_rows)[::-1])))),
    ("an episode's row twice", table(EPISODES, lambda t: pa.concat_tables([t, t.slice(0, 1)]))),
    ("an episode's row is missing", table(EPISODES, lambda t: t.slice(0, t.num_rows - 1))),
    ("rows in a file that is not there", cells(EPISODES, "data/file_index", at(1, lambda v: v + 1))),
    ("rows in a chunk that is not there", cells(EPISODES, "data/chunk_index", at(1, lambda v: v + 1))),
    ("images in a file that is not there", cells(EPISODES, f"videos/{WRIST}/file_index", at(1, lambda v: v + 1))),
    ("images of two episodes exchanged", exchanged_films),
    (
        "images a frame late by their times",
        cells(EPISODES, f"videos/{FRONT}/from_timestamp", lambda v: [t + 0.12 for t in v]),
    ),
    ("images of an episode half a second late by their times", range_late),
    ("images of an episode end late", cells(EPISODES, f"videos/{FRONT}/to_timestamp", at(1, lambda v: v + 1.0))),
    (
        "times of images counted from 0 in each episode",
        cells(EPISODES, f"videos/{WRIST}/from_timestamp", lambda v: [0.0 for _ in v]),
    ),
    ("times of images in ms", cells(EPISODES, f"videos/{WRIST}/from_timestamp", lambda v: [1000 * t for t in v])),
    ("times of images are nothing", cells(EPISODES, f"videos/{WRIST}/from_timestamp", at(1, lambda v: None))),
    (
        "the table of episodes in a file that is not there",
        cells(EPISODES, "meta/episodes/file_index", lambda v: [9 for _ in v]),
    ),
    ("total of frames", info(lambda i: i.update(total_frames=i["total_frames"] - 1))),
    ("total of tasks", info(lambda i: i.update(total_tasks=i["total_tasks"] + 1))),
    ("total of episodes", info(lambda i: i.update(total_episodes=i["total_episodes"] + 1))),
    ("a shape with channels first", info(lambda i: i["features"][FRONT].update(shape=[3, 96, 96]))),
    ("names with channels first", info(lambda i: i["features"][FRONT].update(names=["channels", "height", "width"]))),
    ("frames a second as of television", info(lambda i: i.update(fps=i["fps"] * 0.999))),
    ("paths without numbers", info(lambda i: i.update(data_path="data/chunk-000/episode.parquet"))),
    (
        "paths of v2.1",
        info(lambda i: i.update(data_path="data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet")),
    ),
    ("the version before", info(lambda i: i.update(codebase_version="v2.1"))),
    (
        "joints of another robot",
        info(
            lambda i: renamed(
                i,
                lambda n, names: [
                    name.replace("panda_joint", "joint").replace("iiwa_", "ur_").replace("shoulder", "waist")
                    for name in names
                ],
            )
        ),
    ),
    (
        "names rolled by one",
        info(lambda i: renamed(i, lambda n, names: names[1:] + names[:1] if n in (STATE, ACTION) else names)),
    ),
    (
        "names of the state rolled by one",
        info(lambda i: renamed(i, lambda n, names: names[1:] + names[:1] if n == STATE else names)),
    ),
    ("no files in a chunk", info(lambda i: i.update(chunks_size=0))),
    ("a depth map that is none", info(lambda i: i["features"][FRONT]["info"].update({"is_depth_map": True}))),
    ("sound that is not there", info(lambda i: i["features"][FRONT]["info"].update({"has_audio": True}))),
    (
        "a camera that has no files",
        info(lambda i: i["features"].update({"observation.images.side": i["features"][FRONT]})),
    ),
    ("a camera as a column of images", info(lambda i: i["features"][FRONT].update(dtype="image"))),
    ("a camera that info.json forgot", info(lambda i: i["features"].pop(WRIST))),
    ("statistics of one episode", stats_of_first),
    ("statistics of action and state exchanged", stats(lambda s: exchange(s, ACTION, STATE))),
    ("statistics of the actions before they were scaled", numbers(ACTION, lambda r: 1.05 * r, restat=False)),
    ("image statistics in BGR", stats(lambda s: s[FRONT].update({k: v[::-1] for k, v in s[FRONT].items()}))),
    ("image statistics of two cameras exchanged", stats(lambda s: exchange(s, FRONT, WRIST))),
    (
        "image statistics of ImageNet",
        stats(lambda s: s[FRONT].update(mean=[[[0.485]], [[0.456]], [[0.406]]], std=[[[0.229]], [[0.224]], [[0.225]]])),
    ),
    ("deviation of images halved", stats(lambda s: s[FRONT].update(std=[[[v[0][0] / 2]] for v in s[FRONT]["std"]]))),
    ("deviation of images of 255", stats(lambda s: s[FRONT].update(std=[[[v[0][0] * 255]] for v in s[FRONT]["std"]]))),
    ("limits of images of 255", stats(lambda s: s[FRONT].update(max=[[[255.0]]] * 3))),
    ("quantiles of images missing", stats(lambda s: [s[FRONT].pop(q) for q in loose.QUANTILES])),
    ("statistics of a feature missing", stats(lambda s: s.pop(VELOCITY))),
    ("statistics of a camera missing", stats(lambda s: s.pop(WRIST))),
    ("statistics of a feature that is not there", stats(lambda s: s.update({"observation.force": s[ACTION]}))),
    ("deviations are zeros", stats(lambda s: s[STATE].update(std=[0.0] * len(s[STATE]["std"])))),
    ("deviation as variance", stats(lambda s: s[STATE].update(std=[v**2 for v in s[STATE]["std"]]))),
    ("a mean that is no number", stats(lambda s: s[STATE]["mean"].__setitem__(0, float("nan")))),
    ("means of the episodes' means", stats_mean_of_means),
    ("statistics of two episodes exchanged", cells(EPISODES, f"stats/{STATE}/mean", swap)),
    (
        "statistics of images of two episodes exchanged",
        cells(EPISODES, [f"stats/{WRIST}/{quantity}" for quantity in ("mean", "std")], swap),
    ),
    ("statistics of an episode missing", cells(EPISODES, f"stats/{ACTION}/mean", at(1, lambda v: None))),
    ("statistics of another number of columns", stats(lambda s: s[STATE]["max"].pop())),
)

FILES: tuple[tuple[str, Fault], ...] = (
    ("an empty file of rows", on_disk("data/*/*", lambda p: p.write_bytes(b""))),
    ("a file of rows twice", on_disk("data/*/*", lambda p: shutil.copy(p, p.with_name("file-001.parquet")))),
    ("a file of images twice", on_disk(f"videos/{FRONT}/*/*", lambda p: shutil.copy(p, p.with_name("file-001.mp4")))),
    (
        "a file of episodes twice",
        on_disk("meta/episodes/*/*", lambda p: shutil.copy(p, p.with_name("file-001.parquet"))),
    ),
    ("a pointer for images", on_disk(f"videos/{WRIST}/*/*", pointer)),
    ("a pointer for rows", on_disk("data/*/*", pointer)),
    ("half a table of rows", on_disk("data/*/*", cut)),
    ("half a table of episodes", on_disk("meta/episodes/*/*", cut)),
    ("half a table of tasks", on_disk("meta/tasks.parquet", cut)),
    ("half an info.json", on_disk("meta/info.json", cut)),
    ("half a stats.json", on_disk("meta/stats.json", cut)),
    ("no table of tasks", on_disk("meta/tasks.parquet", Path.unlink)),
    ("no table of episodes", on_disk("meta/episodes/*/*", Path.unlink)),
    ("no file of images", on_disk(f"videos/{FRONT}/*/*", Path.unlink)),
    ("a hole in a file of images", on_disk(f"videos/{FRONT}/*/*", hole)),
    ("a hole in a file of rows", on_disk("data/*/*", hole)),
    ("files of two cameras exchanged", exchanged_files),
    ("a camera's folder of another name", on_disk(f"videos/{WRIST}", lambda p: p.rename(p.with_name("wrist")))),
    ("rows in another chunk", on_disk("data/chunk-000", lambda p: p.rename(p.with_name("chunk-001")))),
    ("images of another dataset's camera", one_file_for_both),
    (
        "a column's name with a blank",
        table("data", lambda t: t.rename_columns([n.replace("next.reward", "next.reward ") for n in t.column_names])),
    ),
    (
        "rows of shorter lists",
        table(
            "data",
            lambda t: t.set_column(
                t.column_names.index(ACTION), ACTION, pa.array([v[:-1] for v in t.column(ACTION).to_pylist()])
            ),
        ),
    ),
    (
        "text for numbers",
        table(
            "data",
            lambda t: t.set_column(
                t.column_names.index("task_index"), "task_index", t.column("task_index").cast(pa.string())
            ),
        ),
    ),
    (
        "counters as floats",
        table(
            "data",
            lambda t: t.set_column(
                t.column_names.index("frame_index"), "frame_index", t.column("frame_index").cast(pa.float64())
            ),
        ),
    ),
)

LANGUAGE: tuple[tuple[str, Fault], ...] = (
    ("language of another episode", said("language_persistent", lambda rows: rows[::-1])),
    ("language an episode late", said("language_persistent", lambda rows: rows[-200:] + rows[:-200])),
    ("only the first subtask", said("language_persistent", first_subtask)),
    ("all subtasks at the start", spoken("subtask", lambda e: e.update(timestamp=0.0))),
    (
        "times of the whole dataset in the language",
        spoken("subtask", lambda e: e.update(timestamp=e["timestamp"] + 100)),
    ),
    ("a plan of another task", spoken("plan", lambda e: e.update(content="1. fold the towel"))),
    (
        "wordings with another colour",
        spoken("task_aug", lambda e: e.update(content=e["content"].replace("red", "yellow"))),
    ),
    ("styles in capitals", spoken("subtask", lambda e: e.update(style="SUBTASK"))),
    ("a trace of normalised points", spoken("trace", points(lambda x, y: [x / 96, y / 96]), "language_events")),
    ("a trace of another camera", spoken("trace", other_camera, "language_events")),
    (
        "a camera by its short name",
        spoken("trace", lambda e: e.update(camera=e["camera"].split(".")[-1]), "language_events"),
    ),
    ("a trace with x and y exchanged", spoken("trace", points(lambda x, y: [y, x]), "language_events")),
    ("nobody says it", spoken("memory", lambda e: e.update(role=None))),
    ("subtasks said by the user", spoken("subtask", lambda e: e.update(role="user"))),
    ("no events", said("language_events", lambda rows: [[] for _ in rows])),
    (
        "motions of the other direction",
        spoken(
            "motion",
            lambda e: e.update(content=e["content"].replace("up", "UP").replace("down", "up").replace("UP", "down")),
        ),
    ),
)

SIDECAR: tuple[tuple[str, Fault], ...] = (
    ("episodes of the sidecar exchanged", cells(KNOWN, "episode_index", swap)),
    ("no paths of cameras", on_disk("demorec/camera_poses", shutil.rmtree)),
    ("no configs", on_disk("demorec/configs.json", Path.unlink)),
    ("no URDF", on_disk("demorec/robots/*.urdf", Path.unlink)),
    (
        "another axis in the URDF",
        on_disk(
            "demorec/robots/*.urdf", lambda p: p.write_text(p.read_text().replace('xyz="0 0 1"', 'xyz="0 1 0"', 1))
        ),
    ),
    ("another kind of action is said", of_json("demorec/export.json", lambda e: e.update(action="ee"))),
    ("another frame rate is said", of_json("demorec/export.json", lambda e: e.update(fps=5))),
    ("a success called a failure", cells(KNOWN, "success", at(1, lambda v: not v))),
    ("digests that are gone", cells(KNOWN, "content_digest", lambda v: [None for _ in v])),
    ("another mass in the scene", cells(KNOWN, "episode_info", at(1, heavier))),
    ("attempts without one episode", table("demorec/attempts", lambda t: t.slice(1))),
    ("an attempt that is not in the dataset", cells("demorec/attempts", "in_dataset", at(0, lambda v: not v))),
    ("another start in the attempts", cells("demorec/attempts", "object_x", at(0, lambda v: v + 0.1))),
    ("another TCP of the robot", on_disk("demorec/robots/*.json", other_tcp)),
    ("camera paths of two episodes exchanged", exchanged_paths),
    ("half of the camera paths", table("demorec/camera_poses", lambda t: t.slice(0, t.num_rows // 2))),
    ("every second frame is said", cells(KNOWN, "frame_stride", lambda v: [2 for _ in v])),
    ("phases ten frames late", cells(KNOWN, "phases", at(1, phases_late))),
    ("a camera that is turned", cells(KNOWN, "cameras", at(1, lambda v: [*v[:-1], turned_mount(v[-1])]))),
    ("an episode twice in the sidecar", table(KNOWN, lambda t: pa.concat_tables([t, t.slice(0, 1)]))),
    ("another config by its digest", cells(KNOWN, "config_digest", at(1, lambda v: "0" * 16))),
    ("another origin", cells(KNOWN, "run_episode_index", at(1, lambda v: v + 40))),
    ("retries that were none", cells(KNOWN, "num_retries", at(1, lambda v: v + 2))),
    ("another final state", cells(KNOWN, "final_state_digest", at(1, lambda v: "0" * len(v or "")))),
    ("another measure of the outcome", cells(KNOWN, "checks", at(1, other_measure))),
    ("a start of another place in the table", cells(EPISODES, "object_x", at(1, lambda v: (v or 0.0) + 0.05))),
    ("another mass in the table", cells(EPISODES, "drawn/object_mass", at(1, lambda v: 2 * (v or 1.0)))),
    ("another duration", cells(EPISODES, "duration_s", at(1, lambda v: 2 * v))),
    ("another distance to the goal", cells(EPISODES, "success_checks/tilt", at(1, lambda v: (v or 0.0) + 0.2))),
    ("another variation", cells(EPISODES, "variation", at(1, lambda v: "none"))),
    ("another seed in the table", cells(EPISODES, "seed", at(1, lambda v: v + 1))),
    ("a behaviour that was not drawn", cells(KNOWN, "behaviour", at(1, lambda v: [(k, x + 0.3) for k, x in v]))),
    ("a source of another name", cells(KNOWN, "source", at(1, lambda v: "elsewhere.mcap"))),
    ("a failure's reason", cells(KNOWN, "failure_reason", at(1, lambda v: "slipped"))),
)

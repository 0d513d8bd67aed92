"""The dataset card: README.md, shown by the Hugging Face Hub.

It is written from the finished dataset, so it also covers appended episodes.
"""

from __future__ import annotations

import hashlib
import os
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from demorec.core.text import markdown
from demorec.datasets.episode import DONE, INTERVENTION, REWARD, SUCCESS
from demorec.datasets.lerobot.episode_table import read_tasks
from demorec.datasets.lerobot.files import read_json, rows_in, write_text
from demorec.datasets.lerobot.language import EVENTS, PERSISTENT
from demorec.datasets.lerobot.layout import AUTOMATIC_FEATURES, DatasetFeature, DatasetInfo
from demorec.datasets.lerobot.options import ExportOptions
from demorec.datasets.lerobot.paths import CARD_PATH, SECOND_CARD_PATH, SIDECAR_DIR
from demorec.datasets.lerobot.robots import ROBOTS_DIR
from demorec.datasets.lerobot.sidecar import ATTEMPT_SCHEMA, CONFIGS_PATH
from demorec.episode.features import (
    ACTION,
    COMMAND,
    EE_POSE,
    ENVIRONMENT_STATE,
    IMAGE_PREFIX,
    STATE,
    VELOCITY,
    ActionKind,
)

_MARK = "<!-- written by demorec, which renews it at every export unless it was edited ({digest}) -->\n"
"""Last line of a card; its digest reveals whether the card was edited."""
_OWN_LICENCE = "apache-2.0"
"""Licence of data that demorec simulated, unless the user names another one."""
_MEANING = {
    **dict.fromkeys(AUTOMATIC_FEATURES, "filled in by LeRobot's rules"),
    "timestamp": "seconds since the episode's start",
    DONE: "true at the last frame",
}
"""Feature -> meaning in every dataset."""
_SIMULATED_MEANING = {
    STATE: "joint positions (rad), gripper opening (m)",
    VELOCITY: "joint velocities (rad/s), speed of the gripper's opening (m/s)",
    EE_POSE: "tool centre point in the base frame: position (m), quaternion xyzw with x >= 0",
    ENVIRONMENT_STATE: "privileged: TCP, objects and goals, symmetric and relative quantities first, raw poses last "
    "(m, rad; base frame)",
    COMMAND: "commands sent to the motors: joint targets (rad), gripper opening (m)",
    REWARD: "1 at the last frame of a success, else 0",
    SUCCESS: "true at the last frame of a success",
    INTERVENTION: "true where the expert acts in an episode that a policy began; its other frames are the policy's",
    PERSISTENT: "statements about the episode, each valid from its `timestamp` until the next one of its style; all of "
    "them in every row",
    EVENTS: "statements of this row alone",
}
_ACTION_MEANING: Mapping[ActionKind, str] = {
    "joint": "absolute joint targets (rad), gripper opening (m)",
    "joint_increment": "joint target minus that of the frame before (rad), the first minus the initial positions, plus "
    "the recovery from exploration noise (demorec.episode.features); gripper opening (m), absolute",
    "ee": "absolute pose of the tool centre point in the base frame: position (m), quaternion xyzw with x >= 0; "
    "gripper opening (m)",
    "ee_delta": "change of the tool centre point's pose since the frame before, the first since the observed one: "
    "translation (m) and rotation vector (rad) in base axes, applied from the left; gripper opening (m), absolute",
}

_SIMULATED_ROWS = (
    "Row t holds the observation at time t, taken before the action of row t is applied; the action is the "
    "expert's target for the next frame. Where exploration noise was added to the motor commands, the action is "
    "derived from the clean target. Frame times are multiples of the simulation's frame period, not of a wall clock."
)
_RECORDED_ROWS = (
    "Row t holds the data of frame t in the recordings; the table above lists the origin of each feature. LeRobot's "
    "timestamps are multiples of the nominal period; the recordings have the exact timestamps of the frames and the "
    "age of each sample."
)
_SIMULATED_SIDECAR = (
    f"`{SIDECAR_DIR}/` holds data without a column in LeRobot: `episodes/` (seed, outcome with every check, phases, "
    "camera intrinsics and extrinsics, poses, the complete scene of every episode), `camera_poses/` (of moving "
    "cameras, per frame, world_from_camera, OpenCV axes), `attempts/` (failed ones too), `configs.json`."
)
_RECORDED_SIDECAR = f"`{SIDECAR_DIR}/episodes/` has the origin, the outcome and the cameras of each episode."


@dataclass(frozen=True, kw_only=True)
class _Provenance:
    """The parts of a card that depend on the source of the episodes.

    Attributes:
        demonstration: Start of the summary: "demonstration{plural} of {robot}", to be formatted.
        origin: demorec's role.
        packets: Source of the video packets, unless images were transcoded.
        licence: Licence unless the user names one; None if unknown.
        tags: Tags in addition to those of every card.
        rows: Meaning of row t.
        sidecar: Content of the sidecar.
    """

    demonstration: str
    origin: str
    packets: str
    licence: str | None
    tags: tuple[str, ...]
    rows: str
    sidecar: str


_SIMULATED = _Provenance(
    demonstration="scripted demonstration{plural} by a simulated {robot} arm in PyBullet",
    origin="Recorded and exported by demorec",
    packets="video packets are stored as recorded",
    licence=_OWN_LICENCE,
    tags=("simulation",),
    rows=_SIMULATED_ROWS,
    sidecar=_SIMULATED_SIDECAR,
)
_RECORDED = _Provenance(
    demonstration="demonstration{plural} of {robot}",
    origin="Exported by demorec",
    packets="video packets are those of the recordings, unchanged",
    licence=None,
    tags=(),
    rows=_RECORDED_ROWS,
    sidecar=_RECORDED_SIDECAR,
)


def write_card(
    root: Path, info: DatasetInfo, options: ExportOptions, meanings: Mapping[str, str], *, is_transcoded: bool
) -> None:
    """Write the card of a finished dataset folder; `meanings` has the features' descriptions in the recordings."""
    there = root / CARD_PATH
    path = root / SECOND_CARD_PATH if has_own_card(root) else there
    path.unlink(missing_ok=True)
    lines = _card(root, info, options, meanings, is_transcoded=is_transcoded)
    write_text(path, _marked("\n".join(lines) + "\n"))


def has_own_card(root: Path) -> bool:
    """Whether a dataset's card belongs to the user: `write_card` did not write it, or it was edited since."""
    path = root / CARD_PATH
    if not os.path.lexists(path):
        return False
    if not path.is_file():
        return True
    text = path.read_bytes().decode(errors="replace")
    return text != _marked(text.rpartition("<!--")[0])


def _marked(text: str) -> str:
    return text + _MARK.format(digest=hashlib.sha256(text.encode()).hexdigest()[:16])


def _card(
    root: Path, info: DatasetInfo, options: ExportOptions, meanings: Mapping[str, str], *, is_transcoded: bool
) -> Iterable[str]:
    configs: Mapping[str, Any] = read_json(root / CONFIGS_PATH)  # empty if demorec simulated no episode
    seeds = rows_in(root, f"{SIDECAR_DIR}/episodes", ["root_seed"])  # null in recordings of other robots
    provenance = _SIMULATED if configs and all(row["root_seed"] is not None for row in seeds) else _RECORDED
    sensed = {name: markdown(source) for name, source in meanings.items() if source}
    meaning = {**_MEANING, **sensed, **(_simulated_meaning(options) if provenance is _SIMULATED else {})}
    tasks = read_tasks(root)
    licence = options.license or provenance.licence
    yield "---"
    if licence is not None:
        yield f"license: {licence}"
    yield from ("task_categories:", "- robotics")
    yield from ("tags:", "- LeRobot", "- demorec", *(f"- {tag}" for tag in provenance.tags))
    yield from ("configs:", "- config_name: default", "  data_files: data/*/*.parquet", "---", "")
    yield from (f"# {options.repo_id}", "", _summary(info, provenance, is_transcoded=is_transcoded))
    yield from ("", "## Task", "", *(f"- {markdown(task)}" for task in tasks[:20]))
    if len(tasks) > 20:
        yield f"- and {len(tasks) - 20} more"
    yield from ("", "## Use", "", "```python", "from lerobot.datasets import LeRobotDataset", "")
    yield '# or with root="path/of/this/folder"; LeRobot\'s default backend, torchcodec, needs FFmpeg installed'
    yield from (f'dataset = LeRobotDataset("{options.repo_id}", video_backend="pyav")', "```", "")
    yield from ("## Features", "", "| feature | type | shape | meaning |", "|---|---|---|---|")
    for key, item in info.features.items():
        name = f"`{key}`" if markdown(key) == key else markdown(key)
        yield f"| {name} | {markdown(item.dtype)} | {list(item.shape)} | {_feature_meaning(key, item, meaning)} |"
    yield from ("", "Names of all components are in `meta/info.json`.", "", "## Contract", "")
    yield from (provenance.rows, "")
    yield from _success_section(root)
    yield from ("## Other files", "", provenance.sidecar)
    yield from _robot_section(root)
    yield ""
    if configs:
        yield from _origin_section(root, configs, options)


def _summary(info: DatasetInfo, provenance: _Provenance, *, is_transcoded: bool) -> str:
    """Describe the dataset's content and origin in one paragraph."""
    robot, plural = markdown(str(info.robot_type)), "" if info.total_episodes == 1 else "s"
    minutes = info.total_frames / info.fps / 60
    demonstrations = provenance.demonstration.format(plural=plural, robot=robot)
    images = "some images were encoded again" if is_transcoded else provenance.packets
    return (
        f"{info.total_episodes} {demonstrations}, {info.total_frames} frames at {info.fps} Hz ({minutes:.1f} minutes), "
        f"in the LeRobot v3.0 format. {provenance.origin}; {images}."
    )


def _robot_section(root: Path) -> Iterable[str]:
    """Describe the URDFs, if the dataset has any."""
    urdfs = sorted((root / ROBOTS_DIR).glob("*.urdf"))
    if urdfs:
        names = ", ".join(f"`{path.relative_to(root).as_posix()}`" for path in urdfs)
        yield ""
        yield (
            f"The robot as a URDF: {names}. The JSON file next to it maps the elements of features to its joints "
            "(`joints`) and, for a simulated robot, has its TCP link, limits and gripper (`spec`)."
        )


def _simulated_meaning(options: ExportOptions) -> dict[str, str]:
    """Return feature -> meaning in a dataset of simulated episodes."""
    meaning = {**_SIMULATED_MEANING, ACTION: _ACTION_MEANING[options.action]}
    if options.state == "joint_ee":
        meaning[STATE] = f"{meaning[STATE]}, {meaning[EE_POSE]}"
    return meaning


def _feature_meaning(key: str, item: DatasetFeature, meaning: Mapping[str, str]) -> str:
    if item.is_depth:
        return "distance along the optical axis, 12-bit logarithmic codes of 0.01 to 10 m; 0.01 m: nothing was hit"
    if key.startswith(IMAGE_PREFIX):
        return f"camera {markdown(key.removeprefix(IMAGE_PREFIX))}, RGB"
    return meaning.get(key, "as in the recordings")


def _origin_section(root: Path, configs: Mapping[str, Any], options: ExportOptions) -> Iterable[str]:
    yield "## Origin"
    yield ""
    for digest, config in configs.items():
        chosen = ", ".join(f"{key} {config[key]}" for key in ("task", "robot", "renderer", "seed") if key in config)
        yield f"- configuration `{markdown(digest) or 'unknown'}`: {markdown(chosen) or 'not recorded'}"
    yield ""
    is_one_run = len(configs) == 1 and not options.append
    if is_one_run and not any(row["origin"] for row in rows_in(root, f"{SIDECAR_DIR}/episodes", ["origin"])):
        yield "This command generates it again from this folder alone and compares every episode bit for bit:"
        yield from ("", "```sh", "generate-dataset --config path/of/this/folder --out copy", "```", "")


def _success_section(root: Path) -> Iterable[str]:
    columns = ["success", "failure_phase", "failure_reason"]
    rows = list(rows_in(root, f"{SIDECAR_DIR}/attempts", columns, schema=ATTEMPT_SCHEMA))
    known = [row for row in rows if row["success"] is not None]
    failed = [row for row in known if not row["success"]]
    total, good = len(known), len(known) - len(failed)
    yield "## Success"
    yield ""
    if num_unknown := len(rows) - total:
        yield f"Episodes with an unknown outcome: {num_unknown}."
        yield ""
    if not total:
        return
    yield f"{good} of {total} attempts that were made for this dataset succeeded ({100 * good / total:.1f} %)."
    counts = Counter[str]()
    for row in failed:
        phase, reason = row["failure_phase"], str(row["failure_reason"])
        counts[f"{reason} in phase {phase}" if phase else reason] += 1
    for reason, count in sorted(counts.items(), key=lambda item: (-item[1], item[0])):
        yield f"- {count} failed: {markdown(reason) or 'no reason recorded'}"
    yield ""

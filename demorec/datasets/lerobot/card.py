"""The dataset card: README.md, as the Hugging Face Hub shows it.

Everything in it is read back from the finished dataset, so it is right after an append too.
"""

from __future__ import annotations

import dataclasses
import hashlib
import os
import shlex
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from demorec.core.config import GenerateConfig, parse_config
from demorec.core.errors import ConfigError
from demorec.core.files import sync_path
from demorec.core.text import markdown, printable
from demorec.datasets.lerobot.files import rows_in
from demorec.datasets.lerobot.language import EVENTS, PERSISTENT
from demorec.datasets.lerobot.layout import AUTOMATIC_FEATURES, DatasetFeature, DatasetInfo
from demorec.datasets.lerobot.options import ExportOptions
from demorec.datasets.lerobot.paths import CARD_PATH, SECOND_CARD_PATH, SIDECAR_DIR, THUMBNAILS_PATH
from demorec.datasets.lerobot.reader import episode_places, read_tasks
from demorec.datasets.lerobot.robots import ROBOTS_DIR
from demorec.datasets.lerobot.sidecar import ATTEMPT_SCHEMA
from demorec.datasets.lerobot.videos import EpisodeVideo
from demorec.datasets.lerobot.writer import write_text
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
from demorec.episode.sensed import SENSED

_MARK = "<!-- written by demorec, which renews it at every export unless it was edited ({digest}) -->\n"
"""The last line of a card: with it a card that was edited is known from one that was not."""
_CELLS = 4
_MEANING = {
    STATE: "joint positions (rad), gripper opening (m)",
    VELOCITY: "joint velocities (rad/s), speed of the gripper's opening (m/s)",
    EE_POSE: "tool centre point in the base frame: position (m), quaternion xyzw with x >= 0",
    ENVIRONMENT_STATE: "privileged: TCP, objects and goals, symmetric and relative quantities first, raw poses last "
    "(m, rad; base frame)",
    COMMAND: "what the motors were sent: joint targets (rad), gripper opening (m)",
    "next.reward": "1 at the last frame of a success, else 0",
    "next.done": "true at the last frame",
    "next.success": "true at the last frame of a success",
    "intervention": "true where the expert acts in an episode that a policy began; its other frames are the policy's",
    "timestamp": "seconds since the episode's start",
    PERSISTENT: "what is said of the episode, each entry from its `timestamp` on until the next one of its style; all "
    "of it in every row",
    EVENTS: "what is said at this row alone: questions about its pictures with their answers, and the like",
}
_ACTION_MEANING: Mapping[ActionKind, str] = {
    "joint": "absolute joint targets (rad), gripper opening (m)",
    "joint_increment": "joint target minus that of the frame before (rad), the first minus the initial positions, plus "
    "the way back from exploration noise (demorec.episode.features); gripper opening (m), absolute",
    "ee": "absolute pose of the tool centre point in the base frame: position (m), quaternion xyzw with x >= 0; "
    "gripper opening (m)",
    "ee_delta": "change of the tool centre point's pose since the frame before, the first since the observed one: "
    "translation (m) and rotation vector (rad) in base axes, applied from the left; gripper opening (m), absolute",
}
_EXTERNAL_ROWS = (
    "Row t holds what was recorded at frame t, as it came. LeRobot's timestamps are multiples of the nominal "
    "period; the frames' own stamps, and how old each sample was, are in the recordings."
)
_SIMULATED_ROWS = (
    "Row t holds the observation at time t, taken before the action of row t is applied; the action is what the "
    "expert wanted to be reached at the next frame. Where exploration noise was added to what the motors got, the "
    "action is derived from the clean target. Frame times are multiples of the simulation's frame period, not of a "
    "wall clock."
)
_BESIDE_EXTERNAL = (
    f"`{SIDECAR_DIR}/episodes/` says where each episode comes from, how it ended and what its cameras were."
)
_BESIDE_SIMULATED = (
    f"`{SIDECAR_DIR}/` holds what LeRobot has no column for: `episodes/` (seed, outcome with every check, phases, "
    "camera intrinsics and extrinsics, poses, the complete scene of every episode), `camera_poses/` (of moving "
    "cameras, per frame, world_from_camera, OpenCV axes), `attempts/` (failed ones too), `configs.json`."
)
_EPISODES, _MOMENTS, _SIDE, _LABEL, _GAP = 4, 5, 160, 18, 2


def write_card(
    root: Path, info: DatasetInfo, options: ExportOptions, configs: Mapping[str, Any], *, is_transcoded: bool
) -> None:
    """Write the card and the thumbnails of a finished dataset folder.

    Args:
        configs: Config digest -> configuration of the runs; none where demorec simulated no episode.
        is_transcoded: Whether any images were encoded anew.
    """
    has_sheet = write_thumbnails(root, info)
    there = root / CARD_PATH
    path = root / SECOND_CARD_PATH if has_own_card(root) else there
    path.unlink(missing_ok=True)
    write_text(path, _marked("\n".join(_card(root, info, options, configs, is_transcoded, has_sheet)) + "\n"))


def has_own_card(root: Path) -> bool:
    """Whether a dataset's card is the user's own: one that `write_card` did not write, or that was edited since."""
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
    root: Path,
    info: DatasetInfo,
    options: ExportOptions,
    configs: Mapping[str, Any],
    is_transcoded: bool,
    has_sheet: bool,
) -> Iterable[str]:
    is_simulated = bool(configs)
    tasks = read_tasks(root)
    minutes = info.total_frames / info.fps / 60
    pictures = "some pictures were coded anew" if is_transcoded else "every video packet is the one that was recorded"
    yield from ("---", f"license: {options.license}", "task_categories:", "- robotics")
    yield from ("tags:", "- LeRobot", "- demorec", *(["- simulation"] if is_simulated else []))
    yield from ("configs:", "- config_name: default", "  data_files: data/*/*.parquet", "---", "")
    yield from (f"# {options.repo_id}", "")
    robot = markdown(str(info.robot_type))
    plural = "" if info.total_episodes == 1 else "s"
    whose = (
        f"scripted demonstration{plural} by a simulated {robot} arm in PyBullet"
        if is_simulated
        else f"demonstration{plural} of {robot}"
    )
    yield (
        f"{info.total_episodes} {whose}, "
        f"{info.total_frames} frames at {info.fps} Hz ({minutes:.1f} minutes), in the LeRobot v3.0 format. Recorded "
        f"and exported by demorec; {pictures}."
    )
    yield from ("", "## Task", "", *(f"- {markdown(task)}" for task in tasks[:20]))
    if len(tasks) > 20:
        yield f"- and {len(tasks) - 20} more"
    if has_sheet:
        yield from ("", f"![First to last picture of some episodes]({THUMBNAILS_PATH})")
    yield from ("", "## Use", "", "```python", "from lerobot.datasets import LeRobotDataset", "")
    yield '# or with root="path/of/this/folder"; LeRobot\'s default backend, torchcodec, needs FFmpeg installed'
    yield from (f'dataset = LeRobotDataset("{options.repo_id}", video_backend="pyav")', "```", "")
    yield from ("## Features", "", "| feature | type | shape | meaning |", "|---|---|---|---|")
    for key, item in info.features.items():
        name = f"`{key}`" if markdown(key) == key else markdown(key)
        yield f"| {name} | {markdown(item.dtype)} | {list(item.shape)} | {_meaning(key, item, options, is_simulated)} |"
    yield from ("", "Names of all components are in `meta/info.json`.", "", "## Contract", "")
    yield from (_SIMULATED_ROWS if is_simulated else _EXTERNAL_ROWS, "")
    yield from _success_section(root)
    yield from ("## What stands beside", "", _BESIDE_SIMULATED if is_simulated else _BESIDE_EXTERNAL)
    yield from _robot_section(root)
    yield ""
    if is_simulated:
        yield from _origin_section(root, configs, options)


def _robot_section(root: Path) -> Iterable[str]:
    """What draws the arm, of a dataset that holds it."""
    urdfs = sorted((root / ROBOTS_DIR).glob("*.urdf"))
    if urdfs:
        names = ", ".join(f"`{path.relative_to(root).as_posix()}`" for path in urdfs)
        yield ""
        yield (
            f"The robot as a URDF: {names}. The JSON file beside it says which element of which feature moves which of "
            "its joints (`joints`), and, of a simulated robot, its TCP link, limits and gripper (`spec`)."
        )


def _meaning(key: str, item: DatasetFeature, options: ExportOptions, is_simulated: bool) -> str:
    if not is_simulated and not key.startswith(IMAGE_PREFIX) and key not in AUTOMATIC_FEATURES and key != "next.done":
        return "as it was recorded"
    if key == ACTION:
        return _ACTION_MEANING[options.action]
    if key == STATE and options.state == "joint_ee":
        return f"{_MEANING[STATE]}, {_MEANING[EE_POSE]}"
    if item.is_depth:
        return "distance along the optical axis, 12-bit logarithmic codes of 0.01 to 10 m; 0.01 m: nothing was hit"
    if key.startswith(IMAGE_PREFIX):
        return f"camera {markdown(key.removeprefix(IMAGE_PREFIX))}, RGB"
    if key in SENSED:
        return SENSED[key].meaning
    return _MEANING.get(key, "filled in by LeRobot's rules")


def _origin_section(root: Path, configs: Mapping[str, Any], options: ExportOptions) -> Iterable[str]:
    yield "## Origin"
    yield ""
    for digest, config in configs.items():
        chosen = ", ".join(f"{key} {config[key]}" for key in ("task", "robot", "renderer", "seed") if key in config)
        yield f"- configuration `{markdown(digest) or 'unknown'}`: {markdown(chosen) or 'not recorded'}"
    yield ""
    commands = making_commands(root, configs, options)
    if commands:
        yield from ("Made by these commands:", "", "```sh", *map(printable, commands), "```", "")
        yield "This makes it again, from what this folder says about itself, and compares every episode to the bit:"
        yield from ("", "```sh", "generate-dataset --config path/of/this/folder --out copy", "```", "")


# ------------------------------------------------------------------------------------------------------ success rates


def _success_section(root: Path) -> Iterable[str]:
    columns = ["success", "failure_phase", "failure_reason", "object_x", "object_y", "goal_x", "goal_y"]
    rows = list(rows_in(root, f"{SIDECAR_DIR}/attempts", columns, schema=ATTEMPT_SCHEMA))
    known = [row for row in rows if row["success"] is not None]
    success = np.array([row["success"] for row in known], dtype=np.bool_)
    total, good = len(success), int(success.sum())
    yield "## Success"
    yield ""
    if num_unknown := len(rows) - total:
        yield f"Of {num_unknown} episodes nobody said whether they succeeded."
        yield ""
    if not total:
        return
    yield f"{good} of {total} attempts that were made for this dataset succeeded ({100 * good / total:.1f} %)."
    counts: dict[str, int] = {}
    for row in (row for row in known if not row["success"]):
        phase, reason = row["failure_phase"], str(row["failure_reason"])
        reason = f"{reason} in phase {phase}" if phase else reason
        counts[reason] = counts.get(reason, 0) + 1
    for reason, count in sorted(counts.items(), key=lambda item: (-item[1], item[0])):
        yield f"- {count} failed: {markdown(reason) or 'no reason recorded'}"
    yield ""
    for what in ("object", "goal"):
        positions = np.array([[row[f"{what}_x"], row[f"{what}_y"]] for row in known], dtype=np.float64)
        if total >= 2 and np.isfinite(positions).all():
            yield f"By the start position of the {what} (successes / attempts, world frame):"
            yield ""
            yield from success_table(positions, success)
            yield ""


def success_table(positions: NDArray[np.float64], success: NDArray[np.bool_]) -> Iterable[str]:
    """Markdown table of successes / attempts over a grid of positions (N, 2), x downwards and y to the right."""
    low, high = positions.min(axis=0), positions.max(axis=0)
    cells = np.where(high - low > 1e-6, _CELLS, 1)
    width = np.where(high > low, high - low, 1.0)
    index = np.clip(((positions - low) / width * cells).astype(np.int64), 0, cells - 1)

    def span(axis: int, cell: int) -> str:
        step = (high[axis] - low[axis]) / cells[axis]
        return f"{low[axis] + cell * step:.3f} to {low[axis] + (cell + 1) * step:.3f} m"

    yield "| x \\ y | " + " | ".join(span(1, column) for column in range(cells[1])) + " |"
    yield "|---" * (cells[1] + 1) + "|"
    for row in range(cells[0]):
        texts = []
        for column in range(cells[1]):
            here = (index[:, 0] == row) & (index[:, 1] == column)
            texts.append(f"{int(success[here].sum())} / {int(here.sum())}" if here.any() else "")
        yield f"| {span(0, row)} | " + " | ".join(texts) + " |"


def write_thumbnails(root: Path, info: DatasetInfo) -> bool:
    """A labelled row per episode, from its first to its last picture; False for a dataset without cameras."""
    key = next((name for name, item in info.features.items() if item.is_video and not item.is_depth), None)
    if key is None:
        return False
    wanted = set(np.linspace(0, info.total_episodes - 1, _EPISODES).round().astype(int).tolist())
    places = [place for place in episode_places(root, info) if place.episode_index in wanted]
    height, width, _ = info.features[key].shape
    scale = _SIDE / max(height, width)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    sheet = Image.new("RGB", ((size[0] + _GAP) * _MOMENTS - _GAP, (size[1] + _LABEL) * len(places)), "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(size=12)
    for row, place in enumerate(places):
        top = row * (size[1] + _LABEL)
        label = f"episode {place.episode_index}, camera {key.removeprefix(IMAGE_PREFIX)}: {', '.join(place.tasks)}"
        draw.text((4, top + 1), printable(label), fill="black", font=font)
        moments = np.linspace(0, place.length - 1, _MOMENTS).round().astype(int).tolist()
        for column, picture in enumerate(EpisodeVideo(info, key, place).images_at(moments)):
            corner = column * (size[0] + _GAP), top + _LABEL
            sheet.paste(Image.fromarray(picture).resize(size, reducing_gap=1.0), corner)
            time = f"{moments[column] / info.fps:.1f} s"
            left, above, right, below = draw.textbbox((corner[0] + 4, corner[1] + 1), time, font=font)
            draw.rectangle((left - 3, above - 2, right + 2, below + 2), fill="black")
            draw.text((corner[0] + 4, corner[1] + 1), time, fill="white", font=font)
    path = root / THUMBNAILS_PATH
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    sheet.save(path, quality=85)
    sync_path(path)
    return True


_NOT_TOLD = ("append", "overwrite", "verify", "workers", "push_to_hub", "public")
"""Options of an export that leave the dataset's content alone."""


def making_commands(root: Path, configs: Mapping[str, Any], options: ExportOptions) -> list[str]:
    """The two commands that generate the run and export it; none where that is not all of the dataset's story.

    That is so when it was made from several runs or by several exports, from replayed or rendered episodes, or by
    another version of demorec whose configuration this one does not understand.

    `configs` has config digests -> configurations of the runs.
    """
    rows = list(rows_in(root, f"{SIDECAR_DIR}/episodes", ["run_episode_index", "origin"]))
    if options.append or len(configs) != 1 or any(row["origin"] for row in rows):
        return []
    try:
        config = parse_config(next(iter(configs.values())), GenerateConfig, source="the configuration")
        config.check_names(config.modules)
    except ConfigError:
        return []
    num_episodes = 1 + max(row["run_episode_index"] for row in rows)
    generating = [f"--num-episodes {num_episodes}", *flags(config, GenerateConfig()), "--no-export --out run"]
    exporting = [f"--repo-id {shlex.quote(options.repo_id)}", *flags(options, ExportOptions(repo_id=options.repo_id))]
    return [
        f"generate-dataset {' '.join(generating)}",
        f"demorec export lerobot run --out dataset {' '.join(exporting)}",
    ]


def flags(values: Any, defaults: Any) -> Iterator[str]:
    """The flags that turn one dataclass into another of its kind: `--seed 7`, `--no-antialias`, `--cameras front`."""
    for field in dataclasses.fields(values):
        value, default = getattr(values, field.name), getattr(defaults, field.name)
        name = field.name.replace("_", "-")
        if field.name in _NOT_TOLD or value == default:
            continue
        if dataclasses.is_dataclass(value):
            yield from flags(value, default)
        elif isinstance(value, bool):
            yield f"--{name}" if value else f"--no-{name}"
        elif isinstance(value, tuple):
            words = value or (("none",) if default else ())  # --cameras none, but a bare --language names no kinds
            yield " ".join([f"--{name}", *(shlex.quote(str(word)) for word in words)])
        else:
            yield f"--{name} {'auto' if value is None else shlex.quote(str(value))}"

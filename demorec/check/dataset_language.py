"""Do the language columns of a dataset say what they must, in LeRobot's form, and is it true of the episode.

The first check needs the columns alone, the second one what demorec keeps beside the dataset: phases, the scene, and
with `--boxes` what each image shows.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from typing import Any

import numpy as np

from demorec.annotate import STATES
from demorec.annotate.questions import ANSWERS
from demorec.annotate.referring import references
from demorec.annotate.situation import COLOR_WORDS, Surroundings, place_of, situation
from demorec.check.base import Found, Measurement, NotMeasured, counted, dataset_check, sidecar_check
from demorec.check.dataset import Dataset
from demorec.datasets.lerobot.boxes import BOXES_DIR, read_boxes
from demorec.datasets.lerobot.language import EpisodeLanguage
from demorec.episode.episode import CORRECTED_PHASE, MISTAKEN_PHASE
from demorec.episode.info import EpisodeInfo

Row = dict[str, Any]
_ABOUT_IMAGES = ("vqa", "trace")
_EVENTS = {*_ABOUT_IMAGES, "interjection", None}
_WORD, _FEWEST_WORDS = re.compile(r"[^\W\d_]{2,}"), 2
_ROLES = ("user", "assistant", "system", "tool")
_ROLE_OF = {"task_aug": "user", "subtask": "assistant", "plan": "assistant", "memory": "assistant"}
"""As lerobot-annotate writes them; LeRobot's trainings leave wordings of others than the user out."""
_STEPS, _LONG_WORD = re.compile(r"^\s*2[.)]", re.MULTILINE), re.compile(r"[^\W\d_]{4,}")
_COLORED = re.compile(rf"\b({'|'.join(COLOR_WORDS)}) (\w+)")
_GOES_M = 0.02
"""How far a hand goes that is said to move up or down."""


@dataset_check(measures="entries of the language columns that are not as LeRobot has them")
def dataset_language(dataset: Dataset) -> Measurement | None:
    """Styles, roles and cameras; one subtask at every frame; times of frames; answers that can be read."""
    if not dataset.spoken:
        return None
    wrong = [
        f"episode {number}: {text}"
        for number, episode in enumerate(dataset.spoken)
        for text in _malformed(dataset, episode)
    ]
    wrong += [*_wrong_motions(dataset), *_wrong_plans(dataset), *_wrong_colors(dataset)]
    entries = sum(len(episode.persistent) + sum(map(len, episode.events.values())) for episode in dataset.spoken)
    return counted(wrong, f"{entries} entries")


@dataset_check(
    measures="instructions that say nothing, or the same as another one",
    fail=math.inf,
)
def dataset_instructions(dataset: Dataset) -> Measurement:
    """Each task says in words what to do: catches names of files, placeholders, and one text under two numbers.

    Other scripts than Latin have no spaces between words, so of them only equal texts count.
    """
    wrong = [text for text in dataset.tasks if text.isascii() and len(_WORD.findall(text)) < _FEWEST_WORDS]
    wrong += [text for number, text in enumerate(dataset.tasks) if text in dataset.tasks[:number]]
    return Measurement(value=len(wrong), detail="; ".join(map(repr, wrong[:3])) or f"{len(dataset.tasks)} tasks")


def _wrong_motions(dataset: Dataset) -> Iterator[str]:
    """Motions that say up or down, and a hand that mostly goes the other way."""
    ways = []
    for motion, episode in zip(dataset.motions.all, dataset.spoken, strict=False):
        if motion.ee_pose is None:
            return
        height = motion.ee_pose[:, 2]
        times = (np.arange(len(height)) / dataset.info.fps).astype(np.float32).tolist()
        said = [row for row in episode.persistent if row.get("style") == "motion" and row.get("timestamp") in times]
        begins = sorted(times.index(row["timestamp"]) for row in said)
        for row in said:
            words = {"up", "down"} & set(_WORD.findall(str(row.get("content")).lower()))
            first = times.index(row["timestamp"])
            last = min([begin for begin in begins if begin > first], default=len(height)) - 1
            if len(words) == 1 and first < last:
                up = float(height[last] - height[first])
                ways += [up if words == {"up"} else -up] if abs(up) > _GOES_M else []
    if sum(way < 0 for way in ways) > max(len(ways) / 2, 2):
        yield "motions say up where the hand goes down, and down where it goes up"


def _wrong_plans(dataset: Dataset) -> Iterator[str]:
    """Plans, and the subtasks that they are plans of."""
    said = [{style: _said(episode, style) for style in ("plan", "subtask")} for episode in dataset.spoken]
    both = [texts for texts in said if all(texts.values())]
    if both and all(len(texts["subtask"]) == 1 for texts in both) and any(_STEPS.search(t["plan"][0]) for t in both):
        yield "plans have several steps, and no episode has a second subtask"
    words = [[set(_LONG_WORD.findall(" ".join(said).lower())) for said in texts.values()] for texts in both]
    # Other scripts than Latin have no spaces between words.
    is_latin = all(text.isascii() for texts in both for said in texts.values() for text in said)
    if is_latin and sum(not plan & subtasks for plan, subtasks in words) > max(len(both) / 2, 2):
        yield "plans have no word in common with the subtasks"


def _wrong_colors(dataset: Dataset) -> Iterator[str]:
    """Wordings, subtasks and plans that give a thing, by its noun, a colour that it has in none of the others."""
    wrong = []
    for rows, episode in zip(dataset.rows, dataset.spoken, strict=False):
        said = {style: _said(episode, style) for style in ("task_aug", "subtask", "plan")}
        said["instruction"] = [dataset.tasks[int(rows["task_index"].reshape(-1)[0])]]
        for style in ("task_aug", "subtask", "plan"):
            others = " ".join(text for other, texts in said.items() if other != style for text in texts)
            known = set(_COLORED.findall(others.lower()))
            nouns = {noun for _, noun in known}
            for text in said[style]:
                strange = [pair for pair in _COLORED.findall(text.lower()) if pair not in known and pair[1] in nouns]
                wrong += [text] if strange else []
    if len(wrong) > 2:
        yield f"colours that the thing has nowhere else ({wrong[0][:60]!r})"


def _said(episode: EpisodeLanguage, style: str) -> list[str]:
    """Texts of a style."""
    return [str(row.get("content")) for row in episode.persistent if row.get("style") == style]


def _malformed(dataset: Dataset, episode: EpisodeLanguage) -> Iterator[str]:
    if episode.differing:
        yield f"language_persistent is another in row {episode.differing[0]}"
    times = (np.arange(episode.num_rows) / dataset.info.fps).astype(np.float32).tolist()
    for row in episode.persistent:
        yield from _entry_faults(row, set(STATES), dataset)
        if row.get("timestamp") not in times:
            yield f"a {row.get('style')} begins at {row.get('timestamp')} s, where no frame is"
    subtasks = sorted(row["timestamp"] for row in episode.persistent if row.get("style") == "subtask")
    is_external = any(row["episode_info"] is None for row in dataset.sidecar)
    if subtasks and subtasks[0] != 0 and not is_external:  # there, words begin when somebody says some
        yield "no subtask holds at the first frame"
    if len(set(subtasks)) < len(subtasks):
        yield "two subtasks begin at one frame"
    for frame, rows in episode.events.items():
        asked = [(row.get("style"), row.get("role"), row.get("camera")) for row in rows]
        if len(set(asked)) < len(asked):
            yield f"frame {frame} has two entries of one style, role and camera"
        for row in rows:
            yield from (f"frame {frame}: {text}" for text in _entry_faults(row, _EVENTS, dataset))
            if row.get("style") in _ABOUT_IMAGES and row.get("role") == "assistant":
                yield from (f"frame {frame}: {text}" for text in _answer_faults(row, dataset))


def _entry_faults(row: Row, styles: set[Any], dataset: Dataset) -> Iterator[str]:
    style, camera = row.get("style"), row.get("camera")
    if style not in styles:
        yield f"{style!r} stands in the wrong column, or is no style"
    if row.get("role") not in _ROLES or row.get("role") != _ROLE_OF.get(str(style), row.get("role")):
        yield f"a {style} by {row.get('role')!r}"
    if not (row.get("content") or row.get("tool_calls")):
        yield f"a {style} that says nothing"
    if style in _ABOUT_IMAGES and camera not in dataset.info.video_keys:
        yield f"a {style} about the camera {camera!r}, which the dataset does not have"
    if style not in _ABOUT_IMAGES and camera is not None:
        yield f"a {style} about a camera"


def _answer_faults(row: Row, dataset: Dataset) -> Iterator[str]:
    answer = _answer(row)
    if answer is None:
        yield "an answer that is no JSON object"
        return
    if row.get("style") == "vqa" and not any(keys <= set(answer) for keys in ANSWERS.values()):
        yield f"an answer of no known kind ({', '.join(answer)})"
    feature = dataset.info.features.get(str(row.get("camera")))
    if feature is None:
        return
    height, width = feature.shape[:2]
    points = list(_points(answer))
    if points and all(0 <= x <= 1 and 0 <= y <= 1 for x, y in points) and any(x % 1 or y % 1 for x, y in points):
        yield "points that are shares of the image"
    for x, y in points:
        if not (0 <= x < width and 0 <= y < height):
            yield f"a point at ({x:g}, {y:g}), outside of the image"
            return


def _answer(row: Row) -> dict[str, Any] | None:
    try:
        found = json.loads(row.get("content") or "")
    except ValueError:
        return None
    return found if isinstance(found, dict) else None


def _points(answer: Row) -> Iterator[tuple[float, float]]:
    """All points that an answer names; (NaN, NaN) for what is none."""
    points = [answer["point"]] if "point" in answer else list(answer.get("points", ()))
    for thing in answer.get("detections", ()):
        box = thing.get("bbox") if isinstance(thing, dict) else None
        points += [box[:2], box[2:]] if isinstance(box, list) and len(box) == 4 else [None]
    for point in points:
        numbers = isinstance(point, list) and len(point) == 2 and all(isinstance(x, int | float) for x in point)
        yield (float(point[0]), float(point[1])) if numbers else (math.nan, math.nan)


@sidecar_check(measures="statements that the phases, the scene or the boxes beside the dataset contradict")
def dataset_language_truth(dataset: Dataset) -> Found:
    """Subtasks change with the phases, words refer to things of the task, boxes and counts are those of the masks."""
    if not dataset.spoken or not dataset.sidecar:
        return None
    if not dataset.infos:
        return NotMeasured(why="the episodes are external, and what they say is as it came")
    wrong = []
    boxes = _boxes_of(dataset)
    for each in (each for each in dataset.described() if each.number < len(dataset.spoken)):
        number, row, info, episode = each.number, each.kept, each.info, dataset.spoken[each.number]
        start = situation(info.scene)
        faults = [
            *_wrong_phases(episode, row, dataset.info.fps),
            *_wrong_words(episode, row, info, start),
            *_wrong_interjections(episode, row, info, start, dataset.info.fps),
            *_wrong_answers(episode, dataset.places[number].from_index, start, boxes),
        ]
        wrong += [f"episode {number}: {text}" for text in faults]
    return counted(wrong, f"{len(dataset.spoken)} episodes")


def _wrong_phases(episode: EpisodeLanguage, row: Row, fps: int) -> Iterator[str]:
    """Check that subtasks begin where phases do."""
    subtasks = [entry for entry in episode.persistent if entry.get("style") == "subtask"]
    if not subtasks:
        return
    starts = [round(entry["timestamp"] * fps) for entry in subtasks]
    phases = [phase["from"] for phase in row["phases"]]
    if starts != phases:
        wrong = sorted(set(starts) ^ set(phases))
        yield f"subtasks and phases change at other frames ({wrong[:3]})"


def _wrong_words(episode: EpisodeLanguage, row: Row, info: EpisodeInfo, start: Surroundings) -> Iterator[str]:
    """Wordings mean the things of the task; subtasks name things of a goal, by kind and colour."""
    scene = info.scene
    objects = {goal.object for goal in scene.goals}
    things = objects | {place_of(scene, goal) for goal in scene.goals} - {""}
    movable = {body.name for body in scene.movable}
    spoken = things | (movable if any(phase["name"] == MISTAKEN_PHASE for phase in row["phases"]) else set())
    for entry in episode.persistent:
        text = entry.get("content") or ""
        if entry.get("style") == "task_aug" and text != info.instruction:
            found = [names for _, names in references(text, start)]
            named = set().union(*found)
            if not all(found) or not things <= named or not named <= things | movable:
                yield f"{text[:60]!r} is not the task, or could mean something else"
        elif entry.get("style") in ("subtask", "plan", "memory") and objects:
            kinds = {(start.thing(name).color, noun) for name in spoken for noun in start.thing(name).nouns}
            for words in _colored(text, start):
                if words not in kinds:
                    yield f"{text[:60]!r} speaks of a {' '.join(words)}, which is not part of the task"


def _wrong_interjections(
    episode: EpisodeLanguage, row: Row, info: EpisodeInfo, start: Surroundings, fps: int
) -> Iterator[str]:
    """Interjections come where the expert listens, say what is meant and what was mistaken, and renew the plan."""
    said = {
        frame: entries
        for frame, rows in episode.events.items()
        if (entries := [entry for entry in rows if entry.get("style") in ("interjection", None)])
    }
    listens = [phase["from"] for phase in row["phases"] if phase["name"] == CORRECTED_PHASE]
    if said and sorted(said) != listens:
        yield f"interjections at {sorted(said)}, but the expert listens at {listens}"
        return
    states = {(entry.get("style"), round(entry["timestamp"] * fps)): entry for entry in episode.persistent}
    plans = [frame for style, frame in states if style == "plan"]
    for frame, entries in said.items():
        wanted = {goal.object for goal in info.scene.goals[:1]}
        before = states.get(("subtask", row["phases"][0]["from"]), {})
        mistaken = _named(before.get("content") or "", start)
        if mistaken & wanted:
            yield f"the subtask before the interjection at frame {frame} names what is meant"
        if [entry.get("style") for entry in entries] != ["interjection", None]:
            yield f"the interjection at frame {frame} and its answer are not both there"
            return
        named = _named(entries[0].get("content") or "", start)
        if not wanted <= named or (before and not named <= wanted | mistaken):
            yield f"the interjection at frame {frame} names {', '.join(sorted(named)) or 'nothing'}"
        if _named("".join(entries[1].get("tool_calls") or ()), start) != wanted:
            yield f"the answer at frame {frame} does not name what is meant"
        if plans and frame not in plans:
            yield f"the interjection at frame {frame} does not renew the plan"


def _named(text: str, start: Surroundings) -> set[str]:
    """Names of all things that a text refers to."""
    return {name for _, names in references(text, start) for name in names}


def _colored(text: str, start: Surroundings) -> Iterator[tuple[str, str]]:
    """(colour, noun) of each phrase of a text that has both."""
    nouns = sorted({noun for thing in start.things for noun in thing.nouns}, key=len, reverse=True)
    pattern = re.compile(rf"\b({'|'.join(COLOR_WORDS)}) ({'|'.join(map(re.escape, nouns))})\b")
    for match in pattern.finditer(text.lower()):
        yield match[1], match[2]


Boxes = dict[str, list[float]]
"""Name of a body -> (x_min, y_min, x_max, y_max)."""


def _boxes_of(dataset: Dataset) -> dict[str, dict[int, Boxes]]:
    """What the files of `--boxes` say: camera -> index of a row -> what its image shows; nothing without them."""
    found: dict[str, dict[int, Boxes]] = {}
    for path in sorted((dataset.path / BOXES_DIR).glob("*.json")):
        of_camera = found.setdefault(path.stem, {})
        for index, name, (x, y, width, height) in read_boxes(path):
            of_camera.setdefault(index, {})[name] = [x, y, x + width - 1, y + height - 1]
    return found


def _wrong_answers(
    episode: EpisodeLanguage, first: int, start: Surroundings, boxes: dict[str, dict[int, Boxes]]
) -> Iterator[str]:
    """Answers that the boxes contradict; `first` is the index of the episode's first row."""
    for frame, rows in episode.events.items():
        for row in rows:
            answer, of_camera = _answer(row), boxes.get(str(row.get("camera")))
            if answer is None or of_camera is None or (row.get("style"), row.get("role")) != ("vqa", "assistant"):
                continue
            seen = of_camera.get(first + frame, {})
            yield from (f"frame {frame}: {text}" for text in _against(answer, seen, start))


def _against(answer: Row, seen: Boxes, start: Surroundings) -> Iterator[str]:
    """Faults of an answer, given what the image shows."""
    if "count" in answer:
        count = sum(answer["label"] in start.thing(name).nouns for name in seen)
        if answer["count"] != count:
            yield f"{answer['count']} {answer['label']}s are counted, {count} are seen"
    for thing in answer.get("detections", ()):
        fitting = [box for name, box in seen.items() if _may_be(thing["label"], name, start)]
        if thing["bbox"] not in fitting:
            yield f"the box of {thing['label']} is that of something else"
    if "point" in answer:
        x, y = answer["point"]
        fitting = [box for name, box in seen.items() if _may_be(answer["label"], name, start)]
        if not any(box[0] <= x <= box[2] and box[1] <= y <= box[3] for box in fitting):
            yield f"the point is not on {answer['label']}"


def _may_be(phrase: str, name: str, start: Surroundings) -> bool:
    """Whether kind and colour of a thing are those of a phrase, wherever it is by now."""
    thing = start.thing(name)
    colors = [word for word in phrase.split() if word in {other.color for other in start.things}]
    return any(noun in phrase for noun in thing.nouns) and (not colors or thing.color in colors)

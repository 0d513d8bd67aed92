"""What of its sources an edited dataset will not have, and why: known before anything is written."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from demorec.datasets.editing.beside import has_stages, poses_are_kept, progress_is_kept
from demorec.datasets.editing.plan import Plan
from demorec.datasets.lerobot.boxes import BOXES_DIR
from demorec.datasets.lerobot.facts import PROGRESS_PATH, PROPORTIONS_PATH
from demorec.datasets.lerobot.paths import CARD_PATH, SECOND_CARD_PATH, SIDECAR_DIR, THUMBNAILS_PATH, is_dataset_file

ABOUT_THE_WHOLE = (CARD_PATH, SECOND_CARD_PATH, ".gitattributes")
"""Files that are copied from a single source."""
_NAMED = 5


def left_out(plan: Plan) -> tuple[str, ...]:
    """One phrase each, with the reason in brackets; what the user chose to leave out is none."""
    found: dict[str, set[str]] = {}
    for number, source in enumerate(plan.sources):
        for name, reason in _files(plan, number, source.root):
            found.setdefault(reason, set()).add(name)
    phrases = []
    for reason, names in found.items():
        more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
        phrases.append(f"{', '.join(sorted(names)[:_NAMED])}{more} ({reason})")
    return (*phrases, *_scenes(plan), *_descriptions(plan), *_attempts(plan), *_facts(plan))


def _files(plan: Plan, number: int, root: Path) -> Iterator[tuple[str, str]]:
    cameras = {take.feature for take in plan.takes[number].values()}
    proportions = [PROPORTIONS_PATH.format(head=head) for head in ("sparse", "dense")]
    keeps_poses, keeps_progress = poses_are_kept(plan), progress_is_kept(plan)
    for path in sorted(root.rglob("*")):
        name = path.relative_to(root).as_posix()
        if not path.is_file() or name.startswith(".cache/"):
            continue
        if not is_dataset_file(name):
            yield name, "of a kind that demorec does not know: copy it if it still holds"
        elif name in ABOUT_THE_WHOLE and len(plan.sources) > 1:
            yield name, "each of the datasets may have its own"
        elif name == THUMBNAILS_PATH:
            yield name, "it shows the episodes of the source"
        elif name.startswith("images/"):
            yield name, "no row has it"
        elif name.startswith(f"{SIDECAR_DIR}/camera_poses/") and not keeps_poses:
            yield name, "other cameras move in the other datasets"
        elif name.startswith(f"{BOXES_DIR}/") and path.stem not in cameras:
            yield name, "its camera is left out"
        elif name == PROGRESS_PATH and not keeps_progress:
            yield name, "not all datasets have progress with the same columns"
        elif name in proportions and not (keeps_progress and has_stages(plan)):
            yield name, "they are those of the source's episodes together"


def _scenes(plan: Plan) -> Iterator[str]:
    lost = 0
    for cut in plan.cuts:
        source = plan.sources[cut.source]
        lost += source.has_scene(source.places[cut.episode].episode_index) and not plan.keeps_scene(cut)
    if lost:
        yield f"scenes of simulated episodes: {lost} (they describe the episode as it was recorded)"


def _descriptions(plan: Plan) -> Iterator[str]:
    spoken = any(feature.dtype == "language" for feature in plan.info.features.values())
    if spoken and (count := sum(bool(cut.task) for cut in plan.cuts)):
        yield f"other wordings (task_aug) in episodes: {count} (they are wordings of the old instruction)"


def _attempts(plan: Plan) -> Iterator[str]:
    lost = 0
    for number, source in enumerate(plan.sources):
        kept = {cut.episode for cut in plan.cuts if cut.source == number}
        gone = [place.episode_index for episode, place in enumerate(source.places) if episode not in kept]
        lost += sum(map(source.attempts.num_failed, gone))
        lost += 0 if plan.takes_all_of(number) else source.attempts.num_homeless
    if lost:
        yield f"failed attempts: {lost} (at episodes that are not in the result)"


def _facts(plan: Plan) -> Iterator[str]:
    names = {name for source in plan.sources if not source.info.is_old for name in source.info.other}
    if lost := sorted(names - set(plan.info.other)):
        yield f"{', '.join(lost)} of info.json (the datasets differ in it)"

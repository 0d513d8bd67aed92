"""`demorec dataset`: LeRobot datasets, whoever wrote them, selected, trimmed, split, merged, renamed, reordered."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from demorec.cli.shared.output import counted, say, say_json, tell
from demorec.cli.shared.paths import refuse_inside
from demorec.cli.shared.progress import ProgressBar
from demorec.core.errors import ConfigError, ExportError
from demorec.core.registry import check_choice
from demorec.datasets.lerobot.paths import is_dataset

if TYPE_CHECKING:
    from demorec.datasets.editing.plan import Plan, Source

_COMMANDS = (
    "select", "drop", "trim", "split", "merge", "rename", "drop-features", "set-task", "reorder", "shuffle",
    "diff", "score",
)  # fmt: skip
_FLAGS = {
    "where": ("select", "drop", "set-task"),
    "episodes": ("select", "drop", "set-task"),
    **dict.fromkeys(("head", "tail", "idle", "idle_feature", "idle_threshold", "idle_margin"), ("trim",)),
    "shares": ("split",),
    "by": ("split", "reorder"),
    "descending": ("reorder",),
    "order": ("reorder",),
    "seed": ("split", "shuffle"),
    "task": ("set-task",),
    "mapping": ("merge",),
    "json": ("diff", "score"),
    "scores": ("select", "drop", "set-task", "split", "reorder"),
    **dict.fromkeys(("out", "overwrite"), tuple(name for name in _COMMANDS if name != "diff")),
    **dict.fromkeys(("decode", "dry_run"), tuple(name for name in _COMMANDS if name not in ("diff", "score"))),
}
"""The commands that each flag is for."""
_SHOWN = 20
"""Differences of each level, and ranges of episodes, that are printed."""


@dataclass(frozen=True, kw_only=True)
class Dataset:
    """Edit LeRobot datasets (v3.0, v2.1), whoever wrote them: no image is encoded again, the sources stay as they are.

    Commands: select and drop episodes (--where, --episodes); trim them (--head, --tail, --idle); split (--shares);
    merge datasets (--mapping); rename OLD=NEW...; drop-features NAME...; set-task; reorder (--by, --order); shuffle.
    diff A B names every difference between two datasets, whatever the order of their episodes (exit code 0: none, 1:
    some).
    score rates every episode from 0 to 1 against the others of its task, with reasons (--json, --out FILE).

    A condition compares columns of the table of episodes or of demorec's sidecar, and episode_index, num_frames,
    duration_s, task, score: success and num_frames < 300; "cube" in task; score > 0.8.

    Examples:
      demorec dataset select cups --where 'success and num_frames < 300' --out good
      demorec dataset drop cups --episodes 3,7,20:25 --out rest
      demorec dataset trim cups --idle --out moving
      demorec dataset split cups --shares train=0.8 val=0.2 --by task --out parts
      demorec dataset merge monday tuesday --out both
      demorec dataset rename cups observation.image=observation.images.top --out new
      demorec dataset set-task cups --task 'pick up the cup' --out relabelled
      demorec dataset reorder cups --by num_frames --out sorted
      demorec dataset diff cups sorted
      demorec dataset score cups --out scores.json
      demorec dataset select cups --where 'score > 0.8' --out good
    """

    command: Annotated[Positional[str], arg(metavar="COMMAND")]
    """What to do."""
    words: Annotated[Positional[tuple[str, ...]], arg(metavar="DATASET")]
    """The dataset, or a run that has one; two or more for merge, two for diff; then the features for rename (OLD=NEW)
    and drop-features."""
    out: Path | None = None
    """Folder of the new dataset; of split the folder in which each part gets one; of score a JSON file."""
    where: str = ""
    """Episodes for which this holds (select, drop, set-task)."""
    episodes: tuple[str, ...] = ()
    """Numbers of episodes, 0,3,5:9 (select, drop, set-task)."""
    head: int = 0
    """Frames to cut off at the beginning of each episode (trim)."""
    tail: int = 0
    """Frames to cut off at the end (trim)."""
    idle: bool = False
    """Cut off what is before the first and after the last motion (trim)."""
    idle_feature: str = "observation.state"
    """Feature whose changes count as motion (trim)."""
    idle_threshold: float = 0.01
    """Motion is a change by more than this share of the feature's range (trim)."""
    idle_margin: int = 3
    """Still frames that stay at either end (trim)."""
    shares: tuple[str, ...] = ()
    """Names and shares of the parts, train=0.8 val=0.2 (split)."""
    by: str = ""
    """Column to sort by (reorder), or to stratify by (split)."""
    descending: bool = False
    """Largest first (reorder)."""
    order: tuple[str, ...] = ()
    """Numbers of all episodes in their new order, 2,0,1 (reorder)."""
    seed: int = 0
    """Seed of the order or the parts (shuffle, split)."""
    task: str = ""
    """The new instruction (set-task)."""
    mapping: Path | None = None
    """Mapping file (TOML) for datasets that differ (merge)."""
    decode: bool = False
    """Decode all images, so that their statistics are exact to the pixel; else those of whole episodes are merged."""
    scores: Path | None = None
    """File of score --out, for conditions and orders by score (auto: the dataset is scored)."""
    overwrite: bool = False
    """Replace a dataset, or a file of scores, that is there."""
    dry_run: bool = False
    """Say what would come out, and write nothing."""
    json: bool = False
    """Print JSON (diff, score)."""

    def run(self) -> int:
        """Plan, write, and say what came out."""
        check_choice("command of demorec dataset", self.command, _COMMANDS)
        for flag, commands in _FLAGS.items():
            if self.command not in commands and getattr(self, flag) != getattr(Dataset, flag):
                name = flag.replace("_", "-")
                raise ConfigError(f"--{name} means nothing to {self.command}: it is for {', '.join(commands)}.")
        from demorec.datasets.lerobot.files import leave_pandas_out

        leave_pandas_out()
        if self.command == "diff":
            return self._diff()
        if self.command == "score":
            return self._score()
        from demorec.datasets.editing.write import write_plan

        for name, plan in self._plans().items():
            self._tell(plan)
            if self.out is None or self.dry_run:
                self._tell_result("Would be ", name, plan, "Would not be taken over")
                continue
            with ProgressBar("writing") as bar:
                decoded, around = write_plan(
                    plan, self.out / name, overwrite=self.overwrite, decode=self.decode, progress=bar.set
                )
            self._tell_result("", name, plan, "Not taken over")
            if around:
                say(f"{counted(around, 'image')} beside cuts stay in the videos, since others need them.")
            if decoded:
                say(f"Images of {counted(decoded, 'episode')} were decoded for their statistics.")
        return 0

    def _plans(self) -> Mapping[str, Plan]:
        """Name within --out -> what is to be written there; everything that stands in the way is refused here."""
        from demorec.datasets.editing.plan import Source
        from demorec.datasets.editing.write import check_target

        usage = f"demorec dataset {self.command} DATASET --out NEW"
        if not self.words:
            raise ConfigError(f"Name a dataset, before the flags: {usage}.")
        if self.out is None and not self.dry_run:
            raise ConfigError(f"Say where the new dataset goes, or ask by --dry-run what it would be: {usage}.")
        num_sources = len(self.words) if self.command == "merge" else 1
        if len(self.words) > num_sources and self.command not in ("rename", "drop-features"):
            raise ConfigError(
                f"demorec dataset {self.command} takes one dataset, and demorec dataset merge joins several: "
                f"what is {self.words[1]!r}?"
            )
        sources = [Source(_dataset(word)) for word in self.words[:num_sources]]
        shares = self._shares() if self.command == "split" else {"": 1.0}
        outs = [self.out / name for name in shares] if self.out is not None else []
        refuse_inside(outs)
        for out in outs:
            check_target(out, [source.root for source in sources], overwrite=self.overwrite)
        self._add_scores(sources[0])
        if self.command != "split":
            return {"": self._plan(sources)}
        from demorec.datasets.editing.operations import split

        return split(sources[0], shares, self.seed, by=self.by)

    def _diff(self) -> int:
        from demorec.datasets.editing.compare import LEVELS
        from demorec.datasets.editing.diff import diff

        if len(self.words) != 2:
            raise ConfigError(f"Two datasets are compared, given are {len(self.words)}: demorec dataset diff A B.")
        a, b = map(_dataset, self.words)
        try:
            with ProgressBar("reading") as bar:
                found = diff(a, b, progress=bar.set)
        except ExportError as error:  # of which the exit code would say that they differ
            raise ConfigError(str(error)) from error
        if self.json:
            say_json(found.to_json())
            return 0 if found.is_same else 1
        for level in LEVELS:
            lines = [item.line for item in found.differences if item.level == level]
            say(*lines[:_SHOWN], *([f"{level}: {len(lines) - _SHOWN} more (--json)"] if len(lines) > _SHOWN else ()))
        say(*found.notes)
        episodes = f"{found.num_same} of {found.num_episodes[0]} and {found.num_episodes[1]} episodes are the same"
        say(f"{'No difference' if found.is_same else counted(len(found.differences), 'difference')}: {episodes}.")
        return 0 if found.is_same else 1

    def _score(self) -> int:
        from demorec.datasets.scoring.score import check_target, score_dataset, to_json, write_scores

        if len(self.words) != 1:
            raise ConfigError(f"One dataset is scored, given are {len(self.words)}: demorec dataset score DATASET.")
        root = _dataset(self.words[0])
        if self.out is not None:
            refuse_inside([self.out])
            check_target(self.out, source=root, overwrite=self.overwrite)
        found = score_dataset(root)
        if self.json:
            say_json(to_json(found))
        for episode in () if self.json else sorted(found, key=lambda episode: episode.score):
            reasons = [f"{reason.text} (frames {reason.first} to {reason.last})" for reason in episode.reasons]
            say(
                f"{episode.score:.2f}  episode {episode.episode_index}" + (f": {'; '.join(reasons)}" if reasons else "")
            )
        if self.out is not None:
            try:
                write_scores(self.out, found)
            except OSError as error:
                raise ExportError(f"The scores cannot be written ({error.strerror}): {self.out}") from error
            tell(f"Scores of {counted(len(found), 'episode')}: {self.out}")
        return 0

    def _add_scores(self, source: Source) -> None:
        """Where a condition or an order is by score, and the dataset has no column of that name."""
        from demorec.datasets.editing.operations import names_in

        if "score" not in names_in(self.where) | {self.by} or any("score" in row for row in source.columns()):
            return
        if self.scores is not None:
            from demorec.datasets.scoring.score import read_scores

            lengths = {place.episode_index: place.length for place in source.places}
            source.scores = read_scores(self.scores, lengths)
        else:
            from demorec.datasets.scoring.score import score_dataset

            source.scores = {episode.episode_index: episode.score for episode in score_dataset(source.root)}

    def _plan(self, sources: Sequence[Source]) -> Plan:
        from demorec.datasets.editing import operations

        source, words = sources[0], self.words[1:]
        match self.command:
            case "select" | "drop":
                if not self.where and not self.episodes:
                    raise ConfigError(f"Say what to {self.command}: --where or --episodes.")
                return operations.select(source, self._chosen(source), drop=self.command == "drop")
            case "trim":
                if self.idle == bool(self.head or self.tail):
                    raise ConfigError("Give either --idle, or frames by --head and --tail.")
                if self.idle:
                    return operations.trim_idle(source, self.idle_feature, self.idle_threshold, self.idle_margin)
                return operations.trim(source, self.head, self.tail)
            case "merge":
                return self._merge(sources)
            case "rename":
                return operations.rename(source, _pairs(words, "rename DATASET OLD=NEW"))
            case "drop-features":
                return operations.drop_features(source, words)
            case "set-task":
                return operations.set_task(source, self.task, self._chosen(source))
            case "reorder":
                return operations.reorder(source, self.by, _numbers(self.order), descending=self.descending)
            case "shuffle":
                return operations.shuffle(source, self.seed)
        raise AssertionError(f"{self.command} has no plan")

    def _merge(self, sources: Sequence[Source]) -> Plan:
        from demorec.datasets.editing.merge import DatasetsDifferError, merge

        try:
            return merge(sources, self.mapping)
        except DatasetsDifferError as error:
            if not error.mapping:
                raise
            say(*error.mapping)
            raise ConfigError(
                f"{error} A mapping could be the lines above: look at each, save them (> FILE) and give --mapping FILE."
            ) from error

    def _shares(self) -> Mapping[str, float]:
        """Name of each part -> its share."""
        example = "--shares train=0.8 val=0.2"
        try:
            pairs = _pairs(" ".join(self.shares).replace(",", " ").split(), example)
            shares = {name: float(share) for name, share in pairs.items()}
        except ValueError as error:
            raise ConfigError(f"A share is a number: {example}.") from error
        if wrong := [name for name in shares if Path(name).name != name or name in ("", ".", "..")]:
            raise ConfigError(f"A part cannot be called {wrong[0]!r}: its name is that of its folder.")
        return shares

    def _chosen(self, source: Source) -> list[int]:
        from demorec.datasets.editing.operations import chosen

        return chosen(source, self.where, _numbers(self.episodes) if self.episodes else None)

    def _tell(self, plan: Plan) -> None:
        """List what is done to episodes."""
        if new := sum(bool(cut.task) for cut in plan.cuts):
            say(f"New instruction: {new} of {counted(len(plan.cuts), 'episode')}")
        for cut in plan.cuts:
            length = plan.sources[cut.source].places[cut.episode].length
            if (cut.first, cut.last) != (0, length):
                head = counted(cut.first, "frame")
                say(f"episode {cut.episode}: {head} cut at the beginning, {length - cut.last} at the end")

    def _tell_result(self, begin: str, name: str, plan: Plan, left: str) -> None:
        """What of the sources is in the result, and what is not."""
        from demorec.datasets.editing.beside import left_out

        lengths = [place.length for source in plan.sources for place in source.places]
        frames = sum(cut.last - cut.first for cut in plan.cuts)
        text = f"{begin}{len(plan.cuts)} of {counted(len(lengths), 'episode')}, {frames} of {sum(lengths)} frames"
        place = str(self.out / name) if self.out is not None else name
        numbers = [cut.episode for cut in plan.cuts]
        if self.dry_run and len(plan.sources) == 1 and numbers != list(range(len(lengths))):
            say(f"episodes {_listed(numbers)}")
        say(f"{text}: {place}" if place else text, *(f"{left}: {item}." for item in left_out(plan)))


def _dataset(word: str) -> Path:
    """The dataset that is named, a run's own where a run is; ConfigError for anything else."""
    from demorec.runs.find import expect
    from demorec.runs.run_file import DATASET

    path = Path(word)
    if expect(path, "dataset", "run").kind == "dataset":
        return path
    if not is_dataset(path / DATASET):
        raise ConfigError(f"This run has no dataset in {DATASET}/, make one (demorec export lerobot): {path}")
    return path / DATASET


def _numbers(texts: Sequence[str]) -> list[int]:
    """Of episodes: 0,3,5:9 or 0 3 5:9; the end of a range is not part of it."""
    found: list[int] = []
    try:
        for part in " ".join(texts).replace(",", " ").split():
            first, colon, last = part.partition(":")
            found += range(int(first), int(last)) if colon else [int(first)]
    except (ValueError, MemoryError, OverflowError):
        found = []
    if texts and not found:
        raise ConfigError(f"Episodes are numbers and ranges, such as 0,3,5:9, not {' '.join(texts)!r}.")
    return found


def _listed(numbers: Sequence[int]) -> str:
    """Some of them, as `_numbers` reads them."""
    parts: list[tuple[int, int]] = []
    for number in numbers:
        joins = parts and parts[-1][1] == number
        parts[-1:] = [(parts[-1][0], number + 1)] if joins else [*parts[-1:], (number, number + 1)]
    texts = [f"{first}:{end}" if end - first > 1 else str(first) for first, end in parts]
    return ",".join(texts[:_SHOWN]) + (",..." if len(texts) > _SHOWN else "")


def _pairs(words: Sequence[str], example: str) -> dict[str, str]:
    found = dict(word.partition("=")[::2] for word in words)
    if not words or any("=" not in word for word in words) or len(found) != len(words):
        given = f", not {' '.join(words)!r}" if words else ""
        raise ConfigError(f"Each name is given once, with what it gets: {example}{given}.")
    return found

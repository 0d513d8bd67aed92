"""Parts that commands on datasets share: the new dataset and its printed summary, and the flags of an arm's servos."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.abc import MetaPathFinder
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from demorec.cli.shared.flags import Positional, arg
from demorec.cli.shared.output import ProgressBar, counted, say
from demorec.cli.shared.paths import refuse_inside
from demorec.core.atomic import atomic_write_all
from demorec.core.errors import ConfigError
from demorec.core.extension import targets_of
from demorec.core.plain import listed
from demorec.core.registry import Registry
from demorec.core.replacing import OptionalTarget, check_replaceable
from demorec.datasets.lerobot.paths import DATASET as DATASET_KIND
from demorec.datasets.lerobot.paths import is_dataset
from demorec.robots.motors import Motors, MotorUnits
from demorec.runs.find import expect
from demorec.runs.run_file import DATASET

if TYPE_CHECKING:
    from demorec.extensions.datasets.folder import LeRobotFolder
    from demorec.extensions.datasets.plan import EpisodeSlice, Plan

_RESULT = replace(DATASET_KIND, advice="choose --overwrite or another --out")
MAX_SHOWN = 20
"""Maximum episodes, or parts of an episode, that are printed."""
DatasetPath = Annotated[Positional[Path], arg(metavar="DATASET", help="A dataset, or a run that has one.")]


class DatasetCommand:
    """Edit LeRobot datasets without re-encoding images or changing the sources.

    Reads any LeRobot dataset (v3.0, v2.1); a run means its own dataset. The result appears complete or not at all.
    """

    commands: Registry[Any] = Registry(kind="command of demorec dataset", rows=targets_of("operations"))


@dataclass(frozen=True, kw_only=True)
class Edit:
    """Flags of every command that writes a dataset."""

    out: OptionalTarget = None
    """Folder of the new dataset."""
    decode: bool = False
    """Decode all images, so that their statistics are exact to the pixel; otherwise those of whole episodes
    are merged.
    """
    overwrite: bool = False
    """Replace an existing dataset."""
    dry_run: bool = False
    """Print a summary of the result without writing it."""

    def sources(self) -> Sequence[LeRobotFolder]:
        """The datasets to read."""
        raise NotImplementedError

    def has_work(self, sources: Sequence[LeRobotFolder]) -> bool:
        """Whether there is anything to write; prints a line if not."""
        return True

    def part_names(self) -> Sequence[str]:
        """Names of the new datasets in --out; "" for --out itself."""
        return [""]

    def plans(self, sources: Sequence[LeRobotFolder]) -> Mapping[str, Plan]:
        """Name in --out -> plan of the new dataset."""
        raise NotImplementedError

    def run(self) -> int:
        """Plan, write, and print a summary."""
        leave_pandas_out()
        if self.out is None and not self.dry_run:
            raise ConfigError("Name the folder of the new dataset (--out NEW), or preview it (--dry-run).")
        sources = self.sources()
        say(*(note for source in sources for note in source.notes))
        if not self.has_work(sources):
            return 0
        outs = [self.out / name for name in self.part_names()] if self.out is not None else []
        refuse_inside(outs)
        if outs and not self.dry_run:
            self._write(sources, outs)
            return 0
        roots = [source.root for source in sources]
        for out in outs:
            check_replaceable(Path.cwd() / out, _RESULT, overwrite=self.overwrite, sources=roots)
        for name, plan in self.plans(sources).items():
            say(*_changes(plan))
            self._print_result("Would be ", name, plan, "Would be left out")
        return 0

    def _write(self, sources: Sequence[LeRobotFolder], outs: Sequence[Path]) -> None:
        """Write the new datasets, which appear together, and print a summary."""
        from demorec.extensions.datasets.write import write_plan

        results: list[tuple[int, int]] = []
        roots = [source.root for source in sources]
        with atomic_write_all(outs, _RESULT, overwrite=self.overwrite, sources=roots) as folders:
            plans = self.plans(sources)
            for plan, folder in zip(plans.values(), folders, strict=True):
                with ProgressBar("writing") as bar:
                    results.append(write_plan(plan, folder, decode=self.decode, progress=bar.set))
        for (name, plan), (decoded, around) in zip(plans.items(), results, strict=True):
            say(*_changes(plan))
            self._print_result("", name, plan, "Left out")
            if around:
                say(f"{counted(around, 'image')} next to cuts stay in the videos, because others need them.")
            if decoded:
                say(f"Images of {counted(decoded, 'episode')} were decoded for their statistics.")

    def _print_result(self, begin: str, name: str, plan: Plan, left: str) -> None:
        from demorec.extensions.datasets.beside import MAX_NAMES, copied_unchecked_files, left_out

        lengths = [place.length for source in plan.sources for place in source.places]
        frames = sum(cut.last - cut.first for cut in plan.cuts)
        numbers = [cut.episode for cut in plan.cuts]
        is_in_parts = len(plan.sources) == 1 and len(set(numbers)) < len(numbers)
        noun = " parts" if is_in_parts else ""
        text = f"{begin}{len(plan.cuts)}{noun} of {counted(len(lengths), 'episode')}, {frames} of {sum(lengths)} frames"
        place = str(self.out / name) if self.out is not None else name
        if self.dry_run and len(plan.sources) == 1 and not is_in_parts and numbers != list(range(len(lengths))):
            say(f"episodes {listed([str(number) for number in numbers], MAX_SHOWN, ',')}")
        say(f"{text}: {place}" if place else text, *(f"{left}: {item}." for item in left_out(plan)))
        if unchecked := copied_unchecked_files(plan):
            say(f"Copied, but not checked: {listed(unchecked, MAX_NAMES, ', ')}. Check that they still apply.")


@dataclass(frozen=True, kw_only=True)
class EditOne(Edit):
    """Flags of every command that makes one dataset from another."""

    dataset: DatasetPath

    def sources(self) -> Sequence[LeRobotFolder]:
        """The dataset."""
        from demorec.extensions.datasets.folder import LeRobotFolder

        return [LeRobotFolder(dataset_at(self.dataset))]

    def plans(self, sources: Sequence[LeRobotFolder]) -> Mapping[str, Plan]:
        """The edited plan of the whole dataset."""
        from demorec.extensions.datasets.plan import Plan

        return {"": self.edited(Plan.whole(sources[0]))}

    def edited(self, plan: Plan) -> Plan:
        """Edit the plan of a whole dataset."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class MotorFlags:
    """The servos of a real arm whose values LeRobot recorded as state and action."""

    motor_units: MotorUnits | None = None
    """Joint units of a dataset that LeRobot recorded with an SO-101 (shoulder_pan.pos to gripper.pos): degrees,
    LeRobot's default, or -100..100 of each joint's range. The dataset does not record the units.
    """
    calibration: Path | None = None
    """With --motor-units: LeRobot's calibration file of the arm (auto: an arm that matches its URDF)."""

    @property
    def named(self) -> Motors | None:
        """The servos; None without --motor-units. Raises ConfigError if the calibration does not match them."""
        from demorec.robots.so101 import SO101_FOLLOWER

        if self.motor_units is not None:
            return SO101_FOLLOWER.motors(self.motor_units, self.calibration)
        if self.calibration is not None:
            raise ConfigError("--calibration belongs to --motor-units.")
        return None


MotorsByFlags = Annotated[MotorFlags, arg(name="")]


def _changes(plan: Plan) -> list[str]:
    """Lines about the changes of episodes."""
    from demorec.extensions.datasets.inspect import mistyped_features

    lines = []
    for source in plan.sources:
        for name, dtype in mistyped_features(source).items():
            claimed = source.info.features[name].dtype
            lines.append(
                f"info.json states {claimed} of {name}, which the data files hold as {dtype}: corrected in the result."
            )
    if new := sum(bool(cut.task) for cut in plan.cuts):
        lines.append(f"New instruction: {new} of {counted(len(plan.cuts), 'episode')}")
    parts: dict[tuple[int, int], list[EpisodeSlice]] = {}
    for cut in plan.cuts:
        parts.setdefault((cut.source, cut.episode), []).append(cut)
    for (number, episode), cuts in parts.items():
        length, cut = plan.sources[number].places[episode].length, cuts[0]
        if not cut.has_end:
            shown = [f"{part.first}:{part.last}" for part in cuts[:MAX_SHOWN]] + ["..."] * (len(cuts) > MAX_SHOWN)
            lines.append(f"episode {episode}: {len(cuts)} parts of {length} frames, {', '.join(shown)}")
        elif (cut.first, cut.last) != (0, length):
            head = counted(cut.first, "frame")
            lines.append(f"episode {cut.episode}: {head} cut at the beginning, {length - cut.last} at the end")
    return list(dict.fromkeys(lines))


def leave_pandas_out() -> None:
    """Make PyArrow work without pandas in this process. PyArrow would import pandas, which takes longer than most
    edits, to check whether given lists are pandas objects.
    """
    import pyarrow as pa

    finder = _NoPandas()
    sys.meta_path.insert(0, finder)
    pa.array([0])  # checks for pandas once and caches the result
    sys.meta_path.remove(finder)


class _NoPandas(MetaPathFinder):
    def find_spec(self, fullname: str, path: Any, target: Any = None) -> None:
        if fullname == "pandas":
            raise ImportError


def dataset_at(path: Path) -> Path:
    """The named dataset, or a run's dataset; ConfigError for anything else."""
    if expect(path, "dataset", "run").kind == "dataset":
        return path
    if not is_dataset(path / DATASET):
        raise ConfigError(f"This run has no dataset in {DATASET}/, create one (demorec export lerobot): {path}")
    return path / DATASET


def pairs(words: Sequence[str], example: str) -> dict[str, str]:
    """Parse NAME=VALUE in each word; ConfigError for anything else."""
    found = dict(word.partition("=")[::2] for word in words)
    if not words or any("=" not in word for word in words) or len(found) != len(words):
        given = f", not {' '.join(words)!r}" if words else ""
        raise ConfigError(f"Each name is given once, with its value: {example}{given}.")
    return found

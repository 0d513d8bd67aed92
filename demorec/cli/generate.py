"""`demorec generate`, also called `generate-dataset`: the main job. `demorec reproduce`: the same data once more."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

from tyro.conf import Positional, arg

from demorec.cli.shared.flags import Allow, allowed_modules
from demorec.cli.shared.output import counted, say, tell
from demorec.cli.shared.paths import refuse_inside
from demorec.cli.shared.progress import ProgressBar
from demorec.core.config import GenerateConfig, read_toml
from demorec.core.errors import ConfigError
from demorec.core.plain import from_plain, to_plain
from demorec.core.registry import nearest_match
from demorec.generate.options import RunObserver, RunOptions

if TYPE_CHECKING:
    from demorec.runs.run_file import Attempt, RunFile


@dataclass(frozen=True, kw_only=True)
class Generate:
    """Generate scripted demonstrations: simulate, record (MCAP), export (LeRobot), check.

    Run the same command again to continue where it stopped. A larger --num-episodes extends the run; a smaller one
    uses its first episodes and leaves the others where they are. The episodes depend on the episode options and the
    seed alone: they are the same for any number of workers, any executor and any order.

    Examples:
      generate-dataset --num-episodes 50 --out recordings/cubes
      generate-dataset --config run.toml --seed 7        (flags override the file)
      generate-dataset --cameras front wrist --width 320 --height 240 --codec av1
      generate-dataset --num-episodes 1000 --dry-run   (time, size and success rate)
      generate-dataset --executor ray --address auto --out /shared/cubes
    """

    config: Path | None = None
    """TOML file with any of the options below, without the dashes: num_episodes = 50."""
    options: Annotated[RunOptions, arg(name="run")] = field(default_factory=RunOptions)
    """How the run is carried out; does not affect the data."""
    check: bool = True
    """Check run, recordings and dataset at the end, without decoding images (demorec check does)."""
    deep_every: int = 50
    """At the end, make the first episode and one in N again from config and seed, and compare every number and image
    with the recording (demorec check --deep does so for all); 0: none."""
    dry_run: bool = False
    """Make a few pilot episodes in a temporary folder and estimate time, size and success rate of the whole run."""
    view: bool = False
    """Show the episodes in Rerun as they are made."""
    episodes: Annotated[GenerateConfig, arg(name="episode")] = field(default_factory=GenerateConfig)
    """What determines the data."""

    @classmethod
    def defaults(cls, args: Sequence[str]) -> Generate:
        """The values of --config, if there is one, are the defaults of the flags."""
        path = config_path(args)
        return cls() if path is None else replace(with_file_values(cls(), path), config=path)

    def run(self) -> int:
        """Generate, export, check, report."""
        self.episodes.validate()
        self.options.validate()
        if self.deep_every < 0:
            raise ConfigError(f"deep-every is {self.deep_every}, allowed are 0 (none) and more.")
        name = self.episodes.task.rpartition(":")[2]  # of somebody else's "package.module:Name", its name
        options = replace(
            self.options,
            out=self.options.out or Path("recordings") / name,
            repo_id=self.options.repo_id or f"local/{name}",
        )
        assert options.out is not None
        refuse_inside([options.out])
        if self.dry_run:
            from demorec.cli.generate_report import print_estimate
            from demorec.generate.estimate import estimate

            print_estimate(*estimate(self.episodes, options), options)
            return 0

        from demorec.cli.generate_report import check_run, print_result
        from demorec.core.processes import terminate_as_interrupt
        from demorec.generate.run import generate

        with ExitStack() as stack:
            watch = stack.enter_context(_viewer(options.out)) if self.view else None
            result = generate(self.episodes, options, progress=stack.enter_context(RunProgress(watch=watch)))
        if result.interrupted:
            done = f"{len(result.run.successes)} of {result.run.num_episodes}"
            tell(f"Interrupted: {done} episodes are complete; run the same command again to continue: {result.folder}")
            return 130
        export, report, checked = None, None, None
        with RunProgress() as progress, terminate_as_interrupt():
            if options.export and result.run.successes:
                from demorec.generate.export_step import export_run

                assert options.repo_id is not None
                export, report = export_run(
                    result.folder, repo_id=options.repo_id, progress=progress.exporting, says=progress.says
                )
            if self.check and result.run.successes:
                checked = check_run(result, deep_every=self.deep_every, progress=progress.checking)
        print_result(result, export, checked)
        if report is not None and report.not_verified:
            tell(f"Not verified: {report.not_verified}")
        return 1 if result.run.given_up or (checked is not None and checked[1]) else 0


class RunProgress(RunObserver, AbstractContextManager["RunProgress"]):
    """How a run goes, one bar after another; a context manager.

    `watch` is called with every attempt that has ended.
    """

    def __init__(self, *, watch: Callable[[Attempt], None] | None = None) -> None:
        self._watch = watch
        self._bar: ProgressBar | None = None
        self._title = ""
        self._failed = 0

    def __exit__(self, *exc: object) -> None:
        if self._bar is not None:
            self._bar.close()

    def verifying(self, done: int, total: int) -> None:
        """Recordings that are there already are being verified."""
        self._show("verifying", total).set(done)

    def checking(self, done: int, total: int) -> None:
        """Run, recordings and dataset are being checked."""
        self._show("checking", total, unit="item").set(done)

    def exporting(self, done: int, total: int) -> None:
        """Recordings are being exported."""
        self._show("exporting", total).set(done)

    def started(self, run: RunFile, workers: int) -> None:
        """The work begins."""
        self._show("generating", run.num_episodes, done=len(run.successes), at_once=workers)

    def ended(self, attempt: Attempt) -> None:
        """An attempt has come to its end."""
        if self._watch is not None:
            self._watch(attempt)
        assert self._bar is not None  # `started` comes first
        if attempt.success:
            self._bar.advance()
        else:
            self._failed += 1
            self._bar.note(counted(self._failed, "failed attempt"))

    def says(self, message: str) -> None:
        """Something that a person should know."""
        tell(message)

    def _show(self, title: str, total: int, *, done: int = 0, unit: str = "episode", at_once: int = 1) -> ProgressBar:
        if self._bar is None or title != self._title:
            if self._bar is not None:
                self._bar.close()
            self._title = title
            self._bar = ProgressBar(title, total=total, done=done, unit=unit, at_once=at_once)
        return self._bar


@contextmanager
def _viewer(folder: Path) -> Iterator[Callable[[Attempt], None]]:
    """A window; what it gives hands finished attempts to it."""
    from demorec.view.live import LiveViewer

    with LiveViewer() as viewer:
        yield lambda attempt: viewer.add(folder / attempt.file) if attempt.file else None


def config_path(args: Sequence[str]) -> Path | None:
    """What --config names on a command line that has not been parsed yet."""
    for position, word in enumerate(args):
        if word == "--config" and position + 1 < len(args):
            return Path(args[position + 1])
        if word.startswith("--config="):
            return Path(word.partition("=")[2])
    return None


def with_file_values[T](command: T, path: Path) -> T:
    """A copy of `command` with the values of a TOML file; its keys are fields of `command` or of dataclasses in it.

    Raises:
        ConfigError: The file cannot be read, or has unknown keys or values of a wrong type; all of them at once.
    """
    values = {key.replace("-", "_"): value for key, value in read_toml(path).items()}
    places = dict(_places(command))
    wrong = [f"an unknown key {key!r}.{nearest_match(key, places)}" for key in values if key not in places]
    if wrong:
        raise ConfigError(f"The config file has {' '.join(wrong)} Its keys are the flags' names: {path}")
    for key, value in values.items():
        owner_path = places[key]
        try:
            command = cast(T, _replaced(command, owner_path, key, value))
        except ValueError as error:
            wrong.append(f"{key}: {str(error).partition(' @ ')[0]}")
    if wrong:
        raise ConfigError(f"The config file has wrong values ({'; '.join(wrong)}): {path}")
    return command


def _places(owner: Any, above: tuple[str, ...] = ()) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Name of each flag -> the fields that lead to the dataclass that has it."""
    for part in dataclasses.fields(owner):
        value = getattr(owner, part.name)
        if dataclasses.is_dataclass(value):
            yield from _places(value, (*above, part.name))
        elif part.name != "config":
            yield part.name, above


def _replaced(owner: Any, above: tuple[str, ...], key: str, value: Any) -> Any:
    if above:
        return dataclasses.replace(owner, **{above[0]: _replaced(getattr(owner, above[0]), above[1:], key, value)})
    if isinstance(getattr(owner, key), tuple) and not isinstance(value, list):
        value = [value]  # cameras = "front" says what it means
    return dataclasses.replace(owner, **{key: getattr(from_plain({**to_plain(owner), key: value}, type(owner)), key)})


@dataclass(frozen=True, kw_only=True)
class Reproduce:
    """Make a run or a dataset again and check that every episode is bit-exact.

    Config and seed are read from run.json or from the dataset's own metadata. The new episodes are compared with what
    the recordings, or the dataset's tables and videos, hold now. Exit code 1 if an episode differs or cannot be read.
    Run the same command again to continue where it stopped.

    Examples:
      demorec reproduce recordings/cubes --out /tmp/cubes
      demorec reproduce datasets/cubes --out /tmp/cubes --workers 8
    """

    source: Positional[Path]
    """A run, or a dataset that was exported from one."""
    out: Path
    """Folder of the new run."""
    workers: int | None = None
    """Processes that simulate (auto: one per core)."""
    executor: Literal["local", "ray"] = "local"
    """Processes on this machine, or tasks on a Ray cluster."""
    address: str = "local"
    """Ray: the cluster, for example auto or HOST:6379; local: this machine only."""
    allow: Allow = ()
    """A module or package of your own that may be imported for the tasks, robots and cameras named in the source."""

    def run(self) -> int:
        """Generate again, compare, report."""
        from demorec.generate.options import RunOptions
        from demorec.generate.reproduce import reproduce

        options = RunOptions(
            out=self.out, workers=self.workers, executor=self.executor, address=self.address, export=False
        )
        options.validate()
        refuse_inside([self.out])
        with RunProgress() as progress:
            result, same, faults = reproduce(
                self.source, options, progress=progress, allowed=allowed_modules(self.allow)
            )
        if result.interrupted:
            tell(f"Interrupted; run the same command again to continue: {self.out}")
            return 130
        say(f"{sum(same.values())} of {len(same)} episodes are bit-exact: {self.source} and {result.folder}")
        before = len(same) - len(result.made)
        if before > 0:
            tell(
                f"Note: {before} of them were in {self.out} already and were not made again: use a new --out to check "
                "them too."
            )
        tell(*faults[:10])
        if different := [
            f"{episode} (attempt {attempt})" for (episode, attempt), is_same in same.items() if not is_same
        ]:
            tell(f"Different: {', '.join(different[:10])}{', ...' if len(different) > 10 else ''}")
            return 1
        return 0

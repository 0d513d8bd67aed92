"""`demorec generate`, also called `generate-dataset`: generate demonstrations."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import arg

from demorec.cli.shared.flags import Allow, allowed_modules
from demorec.cli.shared.output import ProgressBar, counted, tell
from demorec.cli.shared.paths import refuse_inside
from demorec.core.config import GenerateConfig, read_toml
from demorec.core.errors import ConfigError
from demorec.core.files import Closing
from demorec.core.options import Rare
from demorec.core.plain import from_plain, plain_differences, to_plain
from demorec.core.registry import nearest_match
from demorec.generate.options import RunObserver, RunOptions
from demorec.runs.run_file import RUN_NAME

if TYPE_CHECKING:
    from demorec.generate.reproduce import Original
    from demorec.runs.run_file import Attempt, GeneratedRun


_PLACED = re.compile(r"(?:^|(?<=; ))(.*?) @ [\w.]*?(\w+)(?=$|; )")
"""Wrong value and its place in an error of `from_plain`."""


@dataclass(frozen=True, kw_only=True)
class Generate:
    """Generate demonstrations: simulate, record (MCAP), export (LeRobot), check.

    Run the same command again to continue where it stopped; a larger --num-episodes extends the run. The episodes
    depend only on the episode options and the seed, not on the number of workers, the executor or the order.

    Examples:
      generate-dataset --num-episodes 50 --out recordings/cubes
      generate-dataset --config run.toml --seed 7        (flags override the file)
      generate-dataset --cameras front wrist --width 320 --height 240 --codec av1
      generate-dataset --config cubes/run.json --out again   (compares bit for bit)
    """

    config: Path | None = None
    """TOML file of options (num_episodes = 50); or the run.json of a run, or a recording, to make again and compare."""
    allow: Rare[Allow] = ()
    """Module or package of your own that may be imported for tasks, robots and cameras named by --config's run or
    recording.
    """
    options: Annotated[RunOptions, arg(name="run")] = field(default_factory=RunOptions)
    """Options of execution; they do not affect the data."""
    check: Rare[bool] = True
    """Check run, recordings and dataset at the end, without decoding images (see demorec check)."""
    deep_every: Rare[int] = 50
    """At the end, generate the first episode and one in N again from config and seed, and compare every number and
    image with the recording (demorec check --deep: all episodes); 0: none.
    """
    episodes: Annotated[GenerateConfig, arg(name="episode")] = field(default_factory=GenerateConfig)
    """Options that determine the data."""

    @classmethod
    def defaults(cls, args: Sequence[str]) -> Generate:
        """Read the flags' defaults from the options file of --config, if any."""
        path = config_path(args)
        if path is None or _is_original(path):
            return cls()
        return replace(with_file_values(cls(), path), config=path)

    def run(self) -> int:
        """Generate, export, check, report."""
        original = self._original()
        episodes, options = self.episodes, self.options
        if original is not None:
            episodes, options = original.config, replace(options, num_episodes=original.num_episodes)
        episodes.validate()
        options.validate()
        if self.deep_every < 0:
            raise ConfigError(f"deep-every is {self.deep_every}, allowed are 0 (none) or more.")
        name = episodes.task.rpartition(":")[2]  # the name in the user's "package.module:Name"
        options = replace(
            options,
            out=options.out or Path("recordings") / name,
            repo_id=options.repo_id or f"local/{name}",
        )
        assert options.out is not None
        refuse_inside([options.out])
        if original is not None:
            _prepare_comparison(original, options.out)
        from demorec.cli.generate_report import check_run, print_comparison, print_result
        from demorec.core.processes import terminate_as_interrupt
        from demorec.generate.run import generate

        with RunProgress() as progress:
            result = generate(episodes, options, progress=progress)
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
                    result.folder, repo_id=options.repo_id, progress=partial(progress.show, "exporting"), says=tell
                )
            if self.check and result.run.successes:
                checked = check_run(
                    result, deep_every=self.deep_every, progress=partial(progress.show, "checking", unit="item")
                )
        print_result(result, export, checked)
        if report is not None and report.not_verified:
            tell(f"Not verified: {report.not_verified}")
        has_failed = checked is not None and bool(checked[1])
        if original is not None:
            return 0 if print_comparison(original, result) and not has_failed else 1
        return 1 if result.run.given_up or has_failed else 0

    def _original(self) -> Original | None:
        """Read the run or recording that --config names; None without one.

        Raises:
            ConfigError: It cannot be generated again, or flags ask for other episodes or allow unneeded modules.
            NotAllowedError: It names an object of a module that is not allowed.
        """
        if self.config is None or not _is_original(self.config):
            if self.allow:
                raise ConfigError("--allow is for a --config that names a run or recording: leave it out.")
            return None
        from demorec.generate.reproduce import read_original

        asked = {**to_plain(self.episodes), "num_episodes": self.options.num_episodes}
        default = {**to_plain(GenerateConfig()), "num_episodes": RunOptions.num_episodes}
        if different := plain_differences(default, asked):
            flags = [f"--{line.partition(' is ')[0].split()[-1].replace('_', '-')}" for line in different]
            raise ConfigError(
                f"--config generates the episodes of {self.config} again unchanged: leave out {', '.join(flags)}."
            )
        original = read_original(self.config)
        original.config.check_names(allowed_modules(self.allow))
        return original


def _is_original(path: Path) -> bool:
    """Check whether --config names a run or recording and not a TOML file of options."""
    return path.is_dir() or path.name == RUN_NAME or path.suffix == ".mcap"


def _prepare_comparison(original: Original, out: Path) -> None:
    """Refuse to write into the original, and print its versions that differ from the installed ones."""
    from demorec.core.config import deciding_versions
    from demorec.core.own_versions import version_differences
    from demorec.core.replacing import use_as_source

    if overlap := use_as_source(out.resolve(), [original.source]):
        raise ConfigError(f"The copy needs a separate folder, but {overlap}: choose another --out: {out}")
    here = deciding_versions(original.config)
    different = dict.fromkeys(line for there in original.versions for line in version_differences(there, here))
    if different:
        tell(f"Note: {'; '.join(different)}.")


class RunProgress(RunObserver, Closing):
    """Progress of a run, one bar after another; a context manager."""

    def __init__(self) -> None:
        self._bar: ProgressBar | None = None
        self._title = ""
        self._failed = 0

    def close(self) -> None:
        """Remove the last bar from the terminal."""
        if self._bar is not None:
            self._bar.close()

    def verifying(self, done: int, total: int) -> None:
        """Show the verification of existing recordings."""
        self.show("verifying", done, total)

    def show(self, title: str, done: int, total: int, *, unit: str = "episode") -> None:
        """Show the state of an activity; another one than before gets a new bar."""
        if self._bar is None or title != self._title:
            self.close()
            self._title = title
            self._bar = ProgressBar(title, total=total, done=done, unit=unit)
        self._bar.set(done)

    def started(self, run: GeneratedRun) -> None:
        """Show that the work begins."""
        self.show("generating", len(run.successes), run.num_episodes)

    def ended(self, attempt: Attempt) -> None:
        """Show that an attempt has ended."""
        assert self._bar is not None  # `started` is called first
        if attempt.success:
            self._bar.advance()
        else:
            self._failed += 1
            self._bar.note(counted(self._failed, "failed attempt"))

    def says(self, message: str) -> None:
        """Print a message for the user."""
        tell(message)


def config_path(args: Sequence[str]) -> Path | None:
    """Path after --config on a command line that has not been parsed yet."""
    for position, word in enumerate(args):
        if word == "--config" and position + 1 < len(args):
            return Path(args[position + 1])
        if word.startswith("--config="):
            return Path(word.partition("=")[2])
    return None


def with_file_values[T](command: T, path: Path) -> T:
    """Copy `command` with the values of a TOML file; its keys are fields of `command` or of its nested dataclasses.

    Raises:
        ConfigError: The file cannot be read, or has unknown keys or values of a wrong type, all listed at once.
    """
    values = {key.replace("-", "_"): value for key, value in read_toml(path).items()}
    plain = to_plain(command)
    places = dict(_places(plain))
    wrong = [f"an unknown key {key!r}.{nearest_match(key, places)}" for key in values if key not in places]
    if wrong:
        raise ConfigError(f"The config file has {' '.join(wrong)} Its keys are the flags' names: {path}")
    for key, value in values.items():
        is_single = isinstance(places[key][key], list | tuple) and not isinstance(value, list)
        places[key][key] = [value] if is_single else value  # cameras = "front" means one camera
    try:
        return from_plain(plain, type(command))
    except ValueError as error:
        wrong_values = _PLACED.sub(r"\2: \1", str(error))
        raise ConfigError(f"The config file has wrong values ({wrong_values}): {path}") from error


def _places(owner: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Name of each flag -> the object that has its value."""
    for name, value in owner.items():
        if isinstance(value, dict):
            yield from _places(value)
        elif name != "config":
            yield name, owner

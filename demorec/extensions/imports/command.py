"""`demorec import`: import third-party robots' bags to a run."""

from __future__ import annotations

import pkgutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from demorec.cli.shared.flags import Positional, arg
from demorec.cli.shared.output import ProgressBar, aligned, counted, say, size_in_words, tell
from demorec.cli.shared.paths import NamedByFlags, RoleFlags, refuse_inside
from demorec.core.config import VideoConfig
from demorec.core.errors import ConfigError
from demorec.core.extension import ReaderRow, reader_rows
from demorec.core.registry import nearest_match
from demorec.core.replacing import OptionalTarget
from demorec.extensions.datasets.command import MotorFlags, MotorsByFlags
from demorec.runs.find import find

if TYPE_CHECKING:
    from demorec.extensions.imports.episode_writer import FramesImport
    from demorec.extensions.imports.import_file import BagReport

_BAGS = "Bags; each is one episode."
BAGS = reader_rows()["rosbag"]
_FORMATS = {row.word: row for row in reader_rows().values() if row.word}
_WORDS = ", ".join(f"{word} ({form.plural})" for word, form in _FORMATS.items())


@dataclass(frozen=True, kw_only=True)
class Import:
    """Convert another robot's bags (MCAP, rosbag2, ROS 1; without ROS), HDF5 files or LeRobot dataset to a run.

    A mapping (TOML) maps topics to features; --suggest writes one from a bag's content. Each bag is one episode. Every
    row holds messages of the bag and records their age; missing or outdated data is an error. Encoded images pass
    through. Run the same command again to continue. A folder without metadata.yaml means the bags in it.

    A LeRobot dataset (v3.0, v2.1 or v2.0, from any writer) needs no mapping: its features keep their names, its numbers
    stay bit-exact, and its video packets pass through if each episode begins with a keyframe. With --motor-units its
    recordings have the arm's URDF and joints.

    HDF5 files in robomimic's or ALOHA's layout also need a mapping, from datasets to features. Their numbers stay
    bit-exact, JPEG files pass through.

    Examples:
      demorec import --suggest monday.mcap > robot.toml
      demorec import monday.mcap tuesday/ --mapping robot.toml --out runs/robot
      demorec import bags/ --mapping robot.toml --out runs/robot --skip-bad
      demorec import lerobot datasets/cups --out runs/cups
      demorec import lerobot cups --out runs/cups --state joints --action targets
      demorec import hdf5 demo.hdf5 --suggest > mapping.toml
      demorec import hdf5 demo.hdf5 --mapping mapping.toml --out runs/demo
    """

    bags: Annotated[Positional[tuple[Path, ...]], arg(help=f"{_BAGS} Or a word before other sources: {_WORDS}.")]
    mapping: Path | None = None
    """Mapping file (TOML) from topics or datasets to features; required except for formats without --suggest."""
    out: OptionalTarget = None
    """Folder of the run, new or to be continued; required without --suggest."""
    episodes: str = ""
    """Episodes of a dataset to import, counted from 0: 7, or 0:20, or 3,5,8:10; default: all."""
    skip_bad: bool = False
    """Leave out bags that cannot be read, or do not fit the mapping or the other bags, and unreadable episodes of a
    dataset; list them at the end and exit with 1. Otherwise the first of them ends the import.
    """
    suggest: bool = False
    """Write a mapping for the first bag or file to standard output instead of importing."""
    motors: MotorsByFlags = field(default_factory=MotorFlags)
    roles: NamedByFlags = field(default_factory=RoleFlags)
    video: Annotated[VideoConfig, arg(name="")] = field(default_factory=VideoConfig)
    """Encoding of images that arrive as pixels."""

    def run(self) -> int:
        """Import, or suggest a mapping; print the findings; 1 if bags or episodes were skipped."""
        if not self.bags:
            raise ConfigError("No bag is given: name one, e.g. demorec import --suggest monday.mcap.")
        if self.out is not None:
            refuse_inside([self.out])
        word = str(self.bags[0])
        form = _FORMATS.get(word, BAGS)
        self._check_flags(form)
        paths = self.bags if form is BAGS else self.bags[1:]
        if not paths:
            raise ConfigError(
                f"Name {form.name} after the word {word}: {form.command} {form.example}. Give a bag with that name "
                "with its folder."
            )
        if form is BAGS and not paths[0].exists() and (near := nearest_match(word, _FORMATS)):
            raise ConfigError(f"No bag {word!r}.{near} Name bags, or one of {', '.join(_FORMATS)} and its files.")
        from demorec.extensions.imports.bag import bags_in, open_bag

        if self.suggest:
            lines: list[str] = pkgutil.resolve_name(form.suggester)(paths[0], tell)
            if find(paths[0]).kind == "recording":
                tell(f"Note: demorec made this recording, and reads it directly, without an import: {paths[0]}")
            say(*lines)
            return 0
        if form.suggester and (self.mapping is None or self.out is None):
            if form is BAGS:
                open_bag(bags_in(paths[0])[0])  # reports the kind of a path that is not a bag
            raise ConfigError(
                f"An import needs --mapping and --out: {form.command} {paths[0]} --suggest > mapping.toml writes a "
                "mapping."
            )
        if self.out is None:
            raise ConfigError(f"An import needs --out: {form.command} {form.example}.")
        self.video.validate()
        if form is BAGS:
            assert self.mapping is not None, "bags need one"
            return self._import_bags(paths, self.mapping, self.out)
        return self._import_frames(form, paths, self.out)

    def _check_flags(self, form: ReaderRow) -> None:
        """Raise ConfigError for flags of another format."""
        of_datasets = {
            "--motor-units": self.motors.named,
            "--state, --action and --gripper": self.roles.named,
            "--episodes": self.episodes,
            "--skip-bad": form is not BAGS and self.skip_bad,
        }
        if form.suggester and (wrong := [flag for flag, value in of_datasets.items() if value]):
            raise ConfigError(
                f"{wrong[0]}: only for datasets (demorec import lerobot DATASET --out RUN), leave it out."
            )
        if not form.suggester and (self.suggest or self.mapping is not None):
            raise ConfigError(f"The import of {form.name} needs no mapping: leave --mapping and --suggest out.")

    def _import_frames(self, form: ReaderRow, paths: Sequence[Path], out: Path) -> int:
        options: dict[str, Any] = {"video": self.video}
        if not form.suggester:
            options |= {"motors": self.motors.named, "named": self.roles.named}
            options |= {"episodes": self.episodes, "skip_bad": self.skip_bad}
        result: FramesImport = pkgutil.resolve_name(form.importer)(form.files(paths), self.mapping, out, **options)
        say(*(f"camera {name}: {text}" for name, text in result.cameras.items()), *result.left_out_lines())
        if there := result.num_episodes - result.num_new:
            tell(f"{there} of {counted(result.num_episodes, 'episode')} had been imported before.")
        say(f"{counted(result.num_episodes, 'episode')}, {result.num_frames} frames: {out}")
        return _list_skipped(result.skipped, result.num_episodes + len(result.skipped), "episode")

    def _import_bags(self, bags: Sequence[Path], mapping: Path, out: Path) -> int:
        from demorec.extensions.imports.import_run import import_bags

        with ProgressBar("importing", unit="bag") as bar:
            result = import_bags(
                bags,
                mapping,
                out,
                video=self.video,
                skip_bad=self.skip_bad,
                tell=lambda report: say(*_report_lines(report), ""),
                progress=bar.set,
            )
        if result.num_new < len(result.reports):
            tell(f"{len(result.reports) - result.num_new} of {len(result.reports)} bags had been imported before.")
        num_frames = sum(report.num_frames for report in result.reports)
        say(f"{counted(result.num_episodes, 'episode')}, {num_frames} frames: {out}")
        kinds = [finding.kind for report in result.reports for finding in report.odd]
        listed = f"{counted(len(kinds), 'finding')} in the bags ({', '.join(sorted(set(kinds)))})"
        has_notes = len(kinds) < sum(len(report.findings) for report in result.reports)
        none = "No findings but the notes above." if has_notes else "No findings."
        say(f"{listed}, see above and demorec check." if kinds else none)
        return _list_skipped(result.skipped, len(result.reports) + len(result.skipped), "bag")


def _report_lines(report: BagReport) -> list[str]:
    """Describe a bag: a table of its streams, its findings, its episode."""
    lines = aligned([tuple(report.streams[0]), *(tuple(stream.values()) for stream in report.streams)])
    for finding in report.findings:
        place = f"{finding.stream}: " if finding.stream else ""
        lines.append(f"{finding.kind}: {place}{finding.text}")
    lines += report.episode_lines()
    return [f"{report.name} ({size_in_words(report.num_bytes)})", *(f"  {line}" for line in lines)]


def _list_skipped(skipped: Mapping[Any, str], total: int, word: str) -> int:
    """Print the skipped items; return the exit code."""
    if not skipped:
        return 0
    say(f"Skipped {len(skipped)} of {counted(total, word)}:")
    say(*(f"  {name}: {reason}" for name, reason in skipped.items()))
    return 1

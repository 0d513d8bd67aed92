"""Import of bags to a run: every bag is read and judged as a whole, and only then written, as one episode.

The same command continues: bags in import.json are not imported again, existing episodes are not written again.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from demorec.core.config import VideoConfig
from demorec.core.errors import ConfigError, DemorecError, resource_error, without_path
from demorec.core.files import sha256_of
from demorec.core.plain import to_plain
from demorec.extensions.imports.bag import Files, bags_in, open_bag
from demorec.extensions.imports.bag_images import write_bag
from demorec.extensions.imports.description import urdf_text
from demorec.extensions.imports.import_file import BagReport, ImportFile, SkippedBag, load_import_file, save_import_file
from demorec.extensions.imports.mapping import SourceMapping
from demorec.extensions.imports.mapping_file import read_mapping
from demorec.extensions.imports.planning import ImportSettings, PlannedBag, plan_bag
from demorec.extensions.recorder.external_run import ExternalFolder, differences, open_external_run
from demorec.runs.run_file import Attempt

_MAX_REASON = 1000
"""Maximum characters: an error may quote a bag's content."""


@dataclass(kw_only=True)
class BagsImport:
    """Bags of one import, added to the run in order.

    Attributes:
        known: Content of import.json.
        files: Bag in the run -> digests of its files, in the given order.
        skipped: Skipped bag -> reason.
        num_new: Bags imported now; the others existed.
    """

    known: ImportFile
    files: dict[Path, Files] = field(default_factory=dict)
    skipped: dict[Path, str] = field(default_factory=dict)
    num_new: int = 0

    @property
    def reports(self) -> tuple[BagReport, ...]:
        """Reports of the bags in the run, each once, in the given order."""
        reports = {report.files: report for report in self.known.bags}
        return tuple(reports[files] for files in dict.fromkeys(self.files.values()))

    @property
    def num_episodes(self) -> int:
        """Number of episodes from the bags."""
        return len(self.reports)

    def left_out_lines(self) -> Iterator[str]:
        """Describe findings."""
        for report in self.reports:
            if kinds := sorted({finding.kind for finding in report.odd}):
                yield f"{report.name}: findings in the bag ({', '.join(kinds)}), which demorec check lists"

    def plan(self, path: Path, folder: ExternalFolder, settings: ImportSettings) -> PlannedBag | None:
        """Read and judge a bag; None if one with the same bytes is in the run.

        Raises:
            BagError, ConfigError: It cannot be read, or does not fit the mapping or the run.
        """
        bag = open_bag(path)
        files = tuple((file.name, sha256_of(file)) for file in bag.files)
        planned = None
        if files not in {report.files for report in self.known.bags}:
            planned = plan_bag(bag, files, settings, episode_index=len(self.known.bags))
            kind = folder.kind()
            if kind and (different := differences(kind, planned.info)):
                raise ConfigError(
                    f"The run's episodes differ from the bag's ({'; '.join(different)}): import it into another "
                    f"folder: {path}"
                )
        self.files[path] = files
        return planned

    def add(self, report: BagReport, lines: Sequence[Attempt], folder: ExternalFolder) -> None:
        """Add a written bag to the run; run.json, which marks it as done, is written last."""
        self.known = replace(self.known, bags=(*self.known.bags, report))
        save_import_file(self.known, folder.path)
        folder.extend(lines)
        self.num_new += 1

    def save(self, folder: ExternalFolder, given: Sequence[Path]) -> None:
        """Write import.json with the skipped bags, after those of earlier calls that are not given now."""
        names = {path.name for path in given}
        before = [bag for bag in self.known.skipped if bag.name not in names]
        now = [SkippedBag(name=path.name, reason=reason) for path, reason in self.skipped.items()]
        if self.known.bags:
            save_import_file(replace(self.known, skipped=(*before, *now)), folder.path)


def import_bags(
    paths: Sequence[Path],
    mapping_path: Path,
    out: Path,
    *,
    video: VideoConfig | None = None,
    skip_bad: bool = False,
    tell: Callable[[BagReport], None] = lambda report: None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> BagsImport:
    """Import bags to a run, by a mapping.

    Args:
        paths: Bags, each of which is one episode; or folders of bags.
        out: The run's folder; a run started with the same mapping is continued.
        video: Encoding of images that arrive as pixels.
        skip_bad: Whether to leave out bags that cannot be read, or do not fit the mapping or the other bags. Otherwise
        the first of them ends the import before any of it is written.
        tell: Called with the report of each newly read bag, in order.
        progress: Called with the number of finished bags and the total.

    Raises:
        ConfigError: The mapping is impossible, or the folder holds other files.
        BagError: A bag cannot be read, does not fit the mapping, or would yield an incomplete episode.
        RecordingError: The disk is full or gone.
    """
    mapping = read_mapping(mapping_path)
    urdf = urdf_text(mapping, mapping_path)
    known = _known(out, mapping)
    given = list(dict.fromkeys(bag for path in paths for bag in bags_in(path)))
    for path in given:
        if not os.path.lexists(path):  # a mistyped name is not a bad bag
            open_bag(path)
    batch, settings = BagsImport(known=known), ImportSettings(mapping=mapping, urdf=urdf, video=video or VideoConfig())
    progress(0, len(given))
    with open_external_run(out, recovers=False) as folder:
        folder.planned = [path.name for path in given]
        for number, path in enumerate(given, start=1):
            planned: PlannedBag | None = None
            lines: list[Attempt] = []
            try:
                planned = batch.plan(path, folder, settings)
            except Exception as error:
                batch.skipped[path] = _why_skipped(path, error, is_allowed=skip_bad)
            if planned is not None:
                folder.begin(planned.info)
                if not folder.has(planned.info):
                    lines = write_bag(planned, folder.path, settings)
            folder.planned = folder.planned[1:]
            if planned is not None:
                batch.add(planned.report, lines, folder)
                tell(planned.report)
            progress(number, len(given))
        batch.save(folder, given)
    return batch


def _known(out: Path, mapping: SourceMapping) -> ImportFile:
    """Read what was imported before. Raises ConfigError if it was by another mapping."""
    known = load_import_file(out)
    if known is None or not known.bags:
        return ImportFile(mapping=to_plain(mapping), mapping_digest=mapping.digest)
    if known.mapping_digest != mapping.digest:
        raise ConfigError(f"The run was imported by another mapping: choose another --out: {out}")
    return known


def _why_skipped(path: Path, error: Exception, *, is_allowed: bool) -> str:
    """Reason why a bag is left out; raises the error if that was not requested or the machine is at fault."""
    if (lack := resource_error(error)) is not None:
        raise lack from error
    if not is_allowed:
        raise error
    if isinstance(error, DemorecError):
        return without_path(error, path)[:_MAX_REASON]
    return f"unexpected {type(error).__name__}, please report it"

"""Recordings to an HDF5 file: `export_hdf5`, from the first recording to the finished file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from demorec.core.errors import ExportError
from demorec.core.replacing import check_replaceable, written_whole
from demorec.datasets.exported import exported
from demorec.datasets.hdf5.file import DATASET, UNFINISHED, NewFile
from demorec.datasets.hdf5.options import Hdf5Options
from demorec.datasets.hdf5.writer import RobomimicWriter
from demorec.datasets.options import ExportReport, ProgressCallback
from demorec.datasets.sources import (
    ExportSource,
    Intake,
    Profile,
    find_recordings,
    goes_in,
    is_wanted,
    places_of,
)
from demorec.mcap import open_recording


def export_hdf5(
    sources: Sequence[Path], out: Path, options: Hdf5Options, progress: ProgressCallback | None = None
) -> ExportReport:
    """Write the recordings into the file `out`: whole, or not at all. One picture is in memory at a time.

    Args:
        sources: Recordings, runs, or folders of recordings.
        out: The file.
        options: How.
        progress: Called after every recording.

    Raises:
        ConfigError: Impossible options, nothing to export, or a file in the way.
        ExportError: Recordings that differ, a full disk. What was at `out` is still there then.
        RecordingError: A recording is damaged, or lacks pictures that were asked for.
    """
    options.validate()
    found = find_recordings(sources, include_failures=options.include_failures)

    def check() -> None:
        check_replaceable(out, DATASET, overwrite=options.overwrite, sources=places_of(found))

    check()
    target = out.resolve()
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with written_whole(target, UNFINISHED) as part:
            with NewFile(part) as file:
                report = _write(RobomimicWriter(file, options), found, out, progress)
            check()  # something may have been put there meanwhile
    except OSError as error:
        raise ExportError(f"The file cannot be written ({error.strerror or error}): {out}") from error
    return report


def _write(
    writer: RobomimicWriter, found: Sequence[ExportSource], out: Path, progress: ProgressCallback | None
) -> ExportReport:
    options = writer.options
    intake = Intake(found, options)
    for done, source in enumerate(found, start=1):
        with open_recording(source.path) as recording:
            if is_wanted(recording, options):
                if goes_in(source, recording, options):
                    episode = exported(recording, options)
                    intake.take(source.path, Profile.of(episode))
                    writer.add(episode)
                else:
                    intake.leave_out(recording.outcome)
        if progress is not None:
            progress(done, len(found))
    intake.check()
    writer.finish()
    return ExportReport(
        path=out,
        num_episodes=writer.num_episodes,
        num_frames=writer.num_frames,
        new_episodes=writer.num_episodes,
        new_frames=writer.num_frames,
        skipped_failures=intake.skipped_failures,
        skipped_unknown=intake.skipped_unknown,
        skipped_unwanted=intake.skipped_unwanted,
        depth_left_out=intake.depth_left_out,
    )

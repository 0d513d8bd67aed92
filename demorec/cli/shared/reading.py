"""What the commands that read anything have in common: the flag of the mapping, and the names that users know.

Bags, HDF5 files and datasets are read through a temporary run (`demorec.sources.opening`). No line that is written
names it: its episodes are called "demo.hdf5: episode 3".
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from demorec.cli.shared.output import renamed, tell
from demorec.core.errors import DemorecError
from demorec.core.processes import terminate_as_interrupt
from demorec.runs.find import find


@contextmanager
def reading(
    paths: Sequence[Path], mapping: Path | None, *, imports_datasets: bool = False
) -> Iterator[tuple[Path, ...]]:
    """What to read in the place of each path; until the context is left, all output names the user's paths.

    Args:
        paths: As the user named them.
        mapping: Of `--mapping`.
        imports_datasets: Whether the command takes datasets as recordings.

    Raises:
        ConfigError: A mapping is missing, given for what needs none, or impossible; or the disk is too small.
        DemorecError: A path cannot be read.
    """
    imported = {"hdf5", "rosbag", *(["dataset"] if imports_datasets else [])}
    if mapping is None and not imported & {find(path).kind for path in paths}:
        yield tuple(paths)  # without loading what reads bags
        return
    from demorec.sources.opening import opened

    with terminate_as_interrupt(), opened(paths, mapping, imports_datasets=imports_datasets, tell=tell) as found:
        names = {str(run): str(path) for path, run in zip(paths, found, strict=True) if run != path}
        with renamed(names) as in_users_words:
            try:
                yield tuple(found)
            except DemorecError as error:
                error.args = tuple(in_users_words(part) for part in error.args)
                raise

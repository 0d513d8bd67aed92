"""The deep check of a dataset: each episode is made again from what the sidecar says of it, exported, and compared."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from demorec.check.dataset import Dataset
from demorec.check.run_dataset import DatasetEpisode, dataset_episodes, episode_differences, export_options
from demorec.core.errors import ConfigError, DemorecError, resource_error
from demorec.core.own_versions import version_differences
from demorec.datasets.lerobot.options import ExportOptions
from demorec.episode.info import EpisodeInfo
from demorec.loop import SimulatorCache
from demorec.replay.deep.check import DeepReport, versions_here
from demorec.replay.deep.difference import Difference
from demorec.replay.deep.remake import generate_again


def deep_dataset_checks(path: Path, *, allowed: Sequence[str] = ()) -> Iterator[DeepReport]:
    """One report for each episode that the sidecar knows, in order; a single one where that cannot be done.

    Raises:
        ResourceError: This machine cannot do it, which says nothing about the dataset.
    """
    dataset, simulators = Dataset(path), SimulatorCache()
    try:
        if not dataset.sidecar:
            raise ConfigError(f"The dataset does not say how its episodes were made (no demorec/episodes): {path}")
        dataset.check_simulated()
        options = export_options(path)
        infos = {each.number: each.info for each in dataset.described()}
        for episode in dataset_episodes(dataset):
            name = path / f"episode {episode.number}"
            yield _report(name, episode, infos[episode.number], options, simulators, allowed)
    except DemorecError as error:
        if (lack := resource_error(error)) is not None:
            raise lack from error
        yield DeepReport(path=path, error=str(error))
    finally:
        simulators.close()


def _report(
    name: Path,
    episode: DatasetEpisode,
    info: EpisodeInfo,
    options: ExportOptions,
    simulators: SimulatorCache,
    allowed: Sequence[str],
) -> DeepReport:
    versions = version_differences(info.versions, versions_here(info, allowed))
    report = DeepReport(path=name, versions=versions, num_frames=len(episode.rows["index"]))
    try:
        if info.origin:
            raise ConfigError(f"Its recording was derived ({info.origin}), and a dataset does not hold its commands.")
        with tempfile.TemporaryDirectory(prefix="demorec-deep-") as folder:
            again = Path(folder) / "again.mcap"
            generate_again(info, again, simulators, allowed)
            found = tuple(
                Difference(stream="dataset", field=what, frames=frames, recorded="not what comes out", again="")
                for what, frames in episode_differences(again, options, episode)
            )
    except DemorecError as error:
        if (lack := resource_error(error)) is not None:
            raise lack from error
        return replace(report, error=str(error))
    return replace(report, differences=found)

"""What an edit makes: which frames of which episodes of which datasets, and which features they have."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from demorec.core.errors import ConfigError
from demorec.datasets.lerobot.facts import fact_columns
from demorec.datasets.lerobot.files import open_table, read_json_lines, read_table, table_batches, tables_in
from demorec.datasets.lerobot.layout import (
    AUTOMATIC_FEATURES,
    CODEBASE_VERSION,
    DATA_PATH,
    OLD_EPISODES_PATH,
    VIDEO_PATH,
    DatasetFeature,
    DatasetInfo,
)
from demorec.datasets.lerobot.paths import SIDECAR_DIR
from demorec.datasets.lerobot.reader import OpenDataset
from demorec.datasets.lerobot.sidecar import ATTEMPT_SCHEMA
from demorec.datasets.lerobot.stats import NAMES
from demorec.episode.features import ACTION, STATE

_OLD_STATS = "meta/episodes_stats.jsonl"
_BESIDE = ("source", "success", "failure_phase", "failure_reason", "num_retries", "attempt", "run_episode_index")
_SCENE = "root_seed"
"""Stands in the sidecar for each episode whose scene does."""


class Source(OpenDataset):
    """A dataset that is edited.

    Attributes:
        scores: episode_index -> score, where somebody asked for it.
    """

    scores: Mapping[int, float] = MappingProxyType({})

    @property
    def episode_tables(self) -> list[Path]:
        """The files of the table of episodes; none before v3.0."""
        return tables_in(self.root, "meta/episodes")

    @cached_property
    def fact_types(self) -> Mapping[str, Any]:
        """Columns of the table of episodes beyond LeRobot's own -> Arrow type; empty before v3.0."""
        return fact_columns(self.root)

    def facts(self) -> list[dict[str, Any]]:
        """The values of these columns, by episode in order."""
        if self.info.is_old:
            return [{} for _ in self.places]
        return _columns(self.episode_tables, tuple(self.fact_types))

    def statistics(self, features: Sequence[str]) -> Iterator[tuple[int, str, Mapping[str, Any]]]:
        """(episode_index, feature, its statistics as LeRobot writes them) where the episodes' tables have all ten."""
        if self.info.is_old:
            path = self.root / _OLD_STATS
            for line in read_json_lines(path) if path.exists() else ():
                stats, number = line.get("stats"), line.get("episode_index")
                if isinstance(stats, dict) and isinstance(number, int):
                    yield from ((number, name, stats[name]) for name in features if isinstance(stats.get(name), dict))
        for path in self.episode_tables:
            there = set(open_table(path).schema_arrow.names)
            columns = {name: [f"stats/{name}/{key}" for key in NAMES] for name in features}
            complete = {name: wanted for name, wanted in columns.items() if there.issuperset(wanted)}
            for batch in table_batches(path, ["episode_index", *chain.from_iterable(complete.values())]):
                for row in batch.to_pylist():
                    for name, wanted in complete.items():
                        values = [row[column] for column in wanted]
                        if None not in values:
                            yield row["episode_index"], name, dict(zip(NAMES, values, strict=True))

    @property
    def sidecar_tables(self) -> list[Path]:
        """The tables of what demorec keeps beside the episodes."""
        return tables_in(self.root, f"{SIDECAR_DIR}/episodes")

    @cached_property
    def beside(self) -> dict[int, dict[str, Any]]:
        """What demorec keeps beside the episodes: episode_index -> name -> value, as far as it is short."""
        rows = _columns(self.sidecar_tables, (*_BESIDE, _SCENE))
        return {row.pop("episode_index"): row for row in rows}

    def has_scene(self, episode_index: int) -> bool:
        """Whether a scene stands beside an episode."""
        return self.beside.get(episode_index, {}).get(_SCENE) is not None

    @cached_property
    def attempts(self) -> Attempts:
        """The attempts of the sidecar."""
        return Attempts(self.root)

    def columns(self) -> list[dict[str, Any]]:
        """What episodes are chosen and ordered by: name -> value, by episode in order."""
        found = [
            {
                "episode_index": place.episode_index,
                "num_frames": place.length,
                "length": place.length,
                "duration_s": place.length / self.info.fps,
                "task": "; ".join(place.tasks),
                "tasks": list(place.tasks),
            }
            for place in self.places
        ]
        if self.info.is_old:
            lines = read_json_lines(self.root / OLD_EPISODES_PATH)
            for row, line in zip(found, lines, strict=True):
                row |= {name: value for name, value in line.items() if name not in row}
        beside = {
            index: {name: value for name, value in row.items() if name != _SCENE} for index, row in self.beside.items()
        }
        for place, row, facts in zip(self.places, found, self.facts(), strict=True):
            known = {**beside.get(place.episode_index, {}), **facts}
            row |= {name: value for name, value in known.items() if name not in row}
            if place.episode_index in self.scores:
                row.setdefault("score", self.scores[place.episode_index])
        return found


def _columns(tables: Sequence[Path], names: Sequence[str]) -> list[dict[str, Any]]:
    """The rows of tables of episodes, less columns that a table has not."""
    found: list[dict[str, Any]] = []
    for path in tables:
        there = [name for name in ("episode_index", *names) if name in open_table(path).schema_arrow.names]
        for batch in table_batches(path, there):
            found += batch.to_pylist()
    return found


class Attempts:
    """The attempts of a sidecar, by the episode to which each belongs; ExportError when they cannot be read."""

    def __init__(self, root: Path) -> None:
        paths = tables_in(root, f"{SIDECAR_DIR}/attempts")
        tables = [read_table(path, ATTEMPT_SCHEMA.names, schema=ATTEMPT_SCHEMA) for path in paths]
        self._table = pa.concat_tables(tables or [ATTEMPT_SCHEMA.empty_table()]).combine_chunks()
        self._own: dict[int, int] = {}
        self._failed: dict[int, list[int]] = {}
        self._homeless: list[int] = []
        run_indices = self._table.column("run_episode_index").to_pylist()
        waiting: list[int] = []
        for number, episode in enumerate(self._table.column("episode_index").to_pylist()):
            if episode is None:
                waiting.append(number)
                continue
            self._own[episode] = number
            self._failed[episode] = [n for n in waiting if run_indices[n] == run_indices[number]]
            self._homeless += [n for n in waiting if run_indices[n] != run_indices[number]]
            waiting = []
        self._homeless += waiting

    def _rows(self, numbers: Sequence[int]) -> list[dict[str, Any]]:
        return [row for number in numbers for row in self._table.slice(number, 1).to_pylist()]

    def of(self, episode_index: int) -> dict[str, Any] | None:
        """The attempt that became an episode of the dataset."""
        number = self._own.get(episode_index)
        return None if number is None else self._rows([number])[0]

    def failed(self, episode_index: int) -> list[dict[str, Any]]:
        """Failed attempts before an episode."""
        return self._rows(self._failed.get(episode_index, []))

    def homeless(self) -> list[dict[str, Any]]:
        """Failed attempts at episodes that the dataset does not have."""
        return self._rows(self._homeless)


@dataclass(frozen=True, kw_only=True, eq=False)
class FeatureMapping:
    """How a feature of the new dataset comes from one of a source.

    Attributes:
        feature: Its name in the source.
        elements: For each element the number of the source's element; None: all in their order.
        scale, offset: (D,) factor and summand of numbers; None: unchanged.
    """

    feature: str
    elements: tuple[int, ...] | None = None
    scale: NDArray[np.float64] | None = None
    offset: NDArray[np.float64] | None = None

    @property
    def is_copy(self) -> bool:
        """Whether every bit stays."""
        return self.elements is None and self.scale is None

    def apply(self, values: NDArray[Any], dtype: str) -> NDArray[Any]:
        """(T, D) of the new feature from (T, E) of the source's."""
        found = values if self.elements is None else values[:, list(self.elements)]
        if self.scale is not None and self.offset is not None:
            found = found.astype(np.float64) * self.scale + self.offset
        return found.astype(dtype)


@dataclass(frozen=True, kw_only=True)
class EpisodeSlice:
    """The frames from `first` to before `last` of an episode.

    Attributes:
        source: Number of the dataset.
        episode: Number of the episode in it.
        task: Instruction instead of its own; "" for its own.
    """

    source: int
    episode: int
    first: int
    last: int
    task: str = ""


@dataclass(frozen=True, kw_only=True, eq=False)
class Plan:
    """A dataset to be written.

    Attributes:
        sources: What it is made from.
        cuts: Its episodes in order.
        info: Of the new dataset: features, rate, robot, sizes of files.
        mappings: For each source: feature of the new dataset -> where it comes from, less the automatic ones.
    """

    sources: tuple[Source, ...]
    cuts: tuple[EpisodeSlice, ...]
    info: DatasetInfo
    mappings: tuple[Mapping[str, FeatureMapping], ...]

    @classmethod
    def whole(cls, source: Source) -> Plan:
        """All of a dataset as it is."""
        own = {name: feature for name, feature in source.info.features.items() if name not in AUTOMATIC_FEATURES}
        spoken = {name: feature for name, feature in own.items() if feature.dtype == "language"}
        features = {**{k: v for k, v in own.items() if k not in spoken}, **AUTOMATIC_FEATURES, **spoken}
        info = replace(
            source.info, features=features, version=CODEBASE_VERSION, data_path=DATA_PATH, video_path=VIDEO_PATH,
            fps=int(source.info.fps), chunks_size=int(source.info.chunks_size), total_episodes=0, total_frames=0,
            other={} if source.info.is_old else source.info.other,
        )  # fmt: skip
        cuts = tuple(
            EpisodeSlice(source=0, episode=number, first=0, last=place.length)
            for number, place in enumerate(source.places)
        )
        mappings = {name: FeatureMapping(feature=name) for name in own}
        return cls(sources=(source,), cuts=cuts, info=info, mappings=(mappings,))

    def keeps_scene(self, cut: EpisodeSlice) -> bool:
        """Whether an episode is still what its scene describes: all its frames, with its own states and actions."""
        source = self.sources[cut.source]
        if (cut.first, cut.last) != (0, source.places[cut.episode].length):
            return False
        for name in (STATE, ACTION):
            mapping = self.mappings[cut.source].get(name)
            is_kept = mapping is not None and mapping.is_copy and mapping.feature == name
            if name in source.info.features and not is_kept:
                return False
        return True

    def takes_all_of(self, number: int) -> bool:
        """Whether all episodes of a source go along."""
        return {cut.episode for cut in self.cuts if cut.source == number} == set(
            range(len(self.sources[number].places))
        )

    def with_cuts(self, cuts: Sequence[EpisodeSlice]) -> Plan:
        """Other episodes; ConfigError when none is left."""
        if not cuts:
            raise ConfigError("No episode would be left: choose others.")
        return replace(self, cuts=tuple(cuts))

    def with_features(self, features: Mapping[str, DatasetFeature], mappings: Mapping[str, FeatureMapping]) -> Plan:
        """Other features of a plan of one source."""
        return replace(self, info=replace(self.info, features=dict(features)), mappings=(mappings,))

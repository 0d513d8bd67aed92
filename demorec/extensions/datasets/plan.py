"""Plan of an edit: the frames, episodes and features of the new dataset, with their sources."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import ConfigError
from demorec.core.registry import check_choice
from demorec.datasets.lerobot.layout import (
    AUTOMATIC_FEATURES,
    CODEBASE_VERSION,
    DATA_PATH,
    VIDEO_PATH,
    DatasetFeature,
    DatasetInfo,
)
from demorec.episode.features import ACTION, STATE
from demorec.extensions.datasets.dataset_features import is_task_reference
from demorec.extensions.datasets.folder import LeRobotFolder
from demorec.extensions.datasets.inspect import mistyped_features

_KNOWN_REFERENCE = "annotation."
"""Prefix of GR00T's columns with task numbers."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FeatureMapping:
    """Mapping of a feature in the new dataset from one of a source.

    Attributes:
        feature: Its name in the source.
        elements: Index of the source's element for each element; None: all in order.
        scale, offset: (D,) factor and summand; None: unchanged.
    """

    feature: str
    elements: tuple[int, ...] | None = None
    scale: NDArray[np.float64] | None = None
    offset: NDArray[np.float64] | None = None

    @property
    def is_copy(self) -> bool:
        """Whether it is bit-exact."""
        return self.elements is None and self.scale is None

    def apply(self, values: NDArray[Any], dtype: str) -> NDArray[Any]:
        """(T, D) of the new feature from (T, E) of the source's."""
        found = values if self.elements is None else values[:, list(self.elements)]
        if self.scale is not None and self.offset is not None:
            found = found.astype(np.float64) * self.scale + self.offset
        return found.astype(dtype)


@dataclass(frozen=True, kw_only=True)
class EpisodeSlice:
    """Frames `first` to `last` - 1 of an episode.

    Attributes:
        source: Index of the dataset.
        episode: Number of the episode in it.
        task: New instruction; "" to keep its own.
        has_end: Whether it includes the episode's end.
    """

    source: int
    episode: int
    first: int
    last: int
    task: str = ""
    has_end: bool = True


@dataclass(frozen=True, kw_only=True, eq=False)
class Plan:
    """Plan of a dataset to write.

    Attributes:
        sources: Source datasets.
        cuts: Its episodes in order.
        info: Info of the new dataset: features, rate, robot, file sizes.
        mappings: For each source: feature of the new dataset -> its mapping, without the automatic ones.
    """

    sources: tuple[LeRobotFolder, ...]
    cuts: tuple[EpisodeSlice, ...]
    info: DatasetInfo
    mappings: tuple[Mapping[str, FeatureMapping], ...]

    @classmethod
    def whole(cls, source: LeRobotFolder) -> Plan:
        """Plan of a whole dataset, unchanged."""
        own = {name: feature for name, feature in source.info.features.items() if name not in AUTOMATIC_FEATURES}
        types = mistyped_features(source)
        own |= {name: replace(own[name], dtype=types[name]) for name in types if name in own}
        automatic = dict(AUTOMATIC_FEATURES)
        time_type = types.get("timestamp", source.info.features["timestamp"].dtype)
        if time_type in ("float32", "float64"):
            automatic["timestamp"] = replace(automatic["timestamp"], dtype=time_type)
        spoken = {name: feature for name, feature in own.items() if feature.dtype == "language"}
        features = {**{k: v for k, v in own.items() if k not in spoken}, **automatic, **spoken}
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

    def is_whole(self, cut: EpisodeSlice) -> bool:
        """Whether an episode has all frames of its source."""
        return (cut.first, cut.last) == (0, self.sources[cut.source].places[cut.episode].length)

    def keeps_scene(self, cut: EpisodeSlice) -> bool:
        """Whether an episode still matches its scene: all its frames, with its own states and actions."""
        if not self.is_whole(cut):
            return False
        source = self.sources[cut.source]
        for name in (STATE, ACTION):
            mapping = self.mappings[cut.source].get(name)
            is_kept = mapping is not None and mapping.is_copy and mapping.feature == name
            if name in source.info.features and not is_kept:
                return False
        return True

    @property
    def kept_tasks(self) -> tuple[str, ...]:
        """First tasks of the new dataset; none if no column refers to tasks by number."""
        if not any(reference_columns(source.info) for source in self.sources):
            return ()
        return tuple(dict.fromkeys(task for source in self.sources for task in source.tasks))

    def task_numbers(self, number: int) -> NDArray[np.int64]:
        """(N,) numbers of a source's tasks among `kept_tasks`, for the columns that refer to them.

        Raises:
            ConfigError: Numbers change, and a column of unknown kind may refer to them.
        """
        source = self.sources[number]
        if not (references := reference_columns(source.info)):
            return np.zeros(0, np.int64)
        kept = {task: place for place, task in enumerate(self.kept_tasks)}
        numbers = np.array([kept[task] for task in source.tasks], dtype=np.int64)
        taken = {mapping.feature for mapping in self.mappings[number].values()}
        lost = [name for name in references if name in taken and not name.startswith(_KNOWN_REFERENCE)]
        if lost and (numbers != np.arange(len(numbers))).any():
            raise ConfigError(
                f"The column {lost[0]} may hold task numbers, which would change: leave it out first (demorec "
                f"dataset drop-features), or give the datasets the same tasks: {source.root}"
            )
        return numbers

    def with_cuts(self, cuts: Sequence[EpisodeSlice]) -> Plan:
        """Replace the episodes; ConfigError if none is left."""
        if not cuts:
            raise ConfigError("No episode would be left: choose others.")
        return replace(self, cuts=tuple(cuts))

    def with_episodes(self, numbers: Sequence[int]) -> Plan:
        """Keep some episodes of a plan with one source, in this order."""
        return self.with_cuts([self.cuts[number] for number in numbers])

    def with_features(self, features: Mapping[str, DatasetFeature], mappings: Mapping[str, FeatureMapping]) -> Plan:
        """Replace the features of a plan with one source."""
        return replace(self, info=replace(self.info, features=dict(features)), mappings=(mappings,))

    def renamed(self, names: Mapping[str, str]) -> Plan:
        """Rename features of a plan with one source; ConfigError for names that are unknown, fixed or taken."""
        self._check_features(names)
        for name in names.values():
            if not name.isprintable() or "/" in name or not name or name.startswith(".") or ".." in name:
                raise ConfigError(
                    f"A feature cannot be called {name!r}: letters, digits, dots and underscores, no slash."
                )
        new = [names.get(name, name) for name in self.info.features]
        if twice := [name for name in new if new.count(name) > 1]:
            raise ConfigError(f"Two features would be called {twice[0]!r}.")
        return self.with_features(
            {names.get(name, name): feature for name, feature in self.info.features.items()},
            {names.get(name, name): mapping for name, mapping in self.mappings[0].items()},
        )

    def without_features(self, names: Collection[str]) -> Plan:
        """Leave out features of a plan with one source; ConfigError for unknown ones, or if none is left."""
        self._check_features(names)
        mappings = {name: mapping for name, mapping in self.mappings[0].items() if name not in names}
        if not mappings:
            raise ConfigError("No feature would be left.")
        return self.with_features(
            {name: feature for name, feature in self.info.features.items() if name not in names}, mappings
        )

    def _check_features(self, names: Collection[str]) -> None:
        for name in names:
            check_choice("feature that can be changed", name, list(self.mappings[0]))


def reference_columns(info: DatasetInfo) -> tuple[str, ...]:
    """Find the row columns that may refer to the table of tasks by number, such as GR00T's `annotation.*`."""
    return tuple(name for name, feature in info.features.items() if is_task_reference(name, feature))

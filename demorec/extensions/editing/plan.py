"""Plan of an edit: the frames, episodes and features of the new dataset, with their sources."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import ConfigError
from demorec.datasets.lerobot.folder import LeRobotFolder
from demorec.datasets.lerobot.inspect import mistyped_features
from demorec.datasets.lerobot.layout import (
    AUTOMATIC_FEATURES,
    CODEBASE_VERSION,
    DATA_PATH,
    VIDEO_PATH,
    DatasetFeature,
    DatasetInfo,
)
from demorec.episode.features import ACTION, STATE


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

    def keeps_scene(self, cut: EpisodeSlice) -> bool:
        """Whether an episode still matches its scene: all its frames, with its own states and actions."""
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
        """Whether all episodes of a source are included."""
        return {cut.episode for cut in self.cuts if cut.source == number} == set(
            range(len(self.sources[number].places))
        )

    def with_cuts(self, cuts: Sequence[EpisodeSlice]) -> Plan:
        """Replace the episodes; ConfigError if none is left."""
        if not cuts:
            raise ConfigError("No episode would be left: choose others.")
        return replace(self, cuts=tuple(cuts))

    def with_features(self, features: Mapping[str, DatasetFeature], mappings: Mapping[str, FeatureMapping]) -> Plan:
        """Replace the features of a plan with one source."""
        return replace(self, info=replace(self.info, features=dict(features)), mappings=(mappings,))

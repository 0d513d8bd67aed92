"""The choice between the two ways in which episodes are laid out in a file."""

from __future__ import annotations

from demorec.episode.info import EpisodeInfo
from demorec.mcap.sampled_layout import SampledLayout
from demorec.mcap.simulated_layout import SimulatedLayout

EpisodeLayout = SimulatedLayout | SampledLayout


def episode_layout(info: EpisodeInfo) -> EpisodeLayout:
    """Choose the layout of an episode."""
    return SampledLayout(info) if info.simulation is None else SimulatedLayout(info)

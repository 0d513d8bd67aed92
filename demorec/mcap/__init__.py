"""Recordings: one MCAP file per episode, readable by ROS 2, Rerun and Foxglove, from which all outputs are made.

with open_recording(path) as recording:
    recording.table()              # all features
    recording.images("front")      # decoded images
"""

from demorec.mcap.recording import Recording, open_recording, open_simulated
from demorec.mcap.simulated_writer import EpisodeWriter
from demorec.mcap.video import VideoPacket, VideoSettings

__all__ = [
    "EpisodeWriter",
    "Recording",
    "VideoPacket",
    "VideoSettings",
    "open_recording",
    "open_simulated",
]

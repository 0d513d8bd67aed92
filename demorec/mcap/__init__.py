"""Recordings: one MCAP file an episode, readable by ROS 2, Rerun and Foxglove, and the source of everything after.

with EpisodeWriter(path, info) as writer:
    for frame in frames:
        writer.write(frame)
    writer.finish(outcome)

with Recording(path) as recording:
    recording.columns()            # all numbers
    recording.images("front")      # decoded pictures
"""

from demorec.mcap.external.reader import CollectedRecording
from demorec.mcap.external.writer import CollectedWriter
from demorec.mcap.file_writer import WriteStats
from demorec.mcap.opening import AnyRecording, open_recording
from demorec.mcap.pixels import PixelStatistics
from demorec.mcap.recording import Recording
from demorec.mcap.recover import Recovered, is_whole, recover
from demorec.mcap.video import VideoPacket, VideoSettings
from demorec.mcap.writer import EpisodeWriter

__all__ = [
    "AnyRecording",
    "CollectedRecording",
    "CollectedWriter",
    "EpisodeWriter",
    "PixelStatistics",
    "Recording",
    "Recovered",
    "VideoPacket",
    "VideoSettings",
    "WriteStats",
    "is_whole",
    "open_recording",
    "recover",
]

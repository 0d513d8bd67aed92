"""Recordings: one MCAP file an episode, readable by ROS 2, Rerun and Foxglove, and the source of everything after.

with EpisodeWriter(path, info) as writer:
    for frame in frames:
        writer.write(frame)
    writer.finish(outcome)

with Recording(path) as recording:
    recording.columns()            # all numbers
    recording.images("front")      # decoded pictures
"""

from demorec.recording.collected.reader import CollectedRecording
from demorec.recording.collected.writer import CollectedWriter
from demorec.recording.file_writer import WriteStats
from demorec.recording.opening import AnyRecording, open_recording
from demorec.recording.pixels import PixelStatistics
from demorec.recording.recording import Recording
from demorec.recording.recover import Recovered, is_whole, recover
from demorec.recording.video import VideoPacket, VideoSettings
from demorec.recording.writer import EpisodeWriter

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

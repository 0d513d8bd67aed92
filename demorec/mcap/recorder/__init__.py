"""Recording of episodes of any robot or program: `Recorder`.

with Recorder("runs/mine", robot="so101", cameras={"top": (480, 640)}, fps=30, task="stack the cups") as recorder:
    with recorder.episode() as episode:
        episode.write(observation, action, images)
        episode.success = True
"""

from demorec.mcap.recorder.recorder import RecordedEpisode, Recorder

__all__ = ["RecordedEpisode", "Recorder"]

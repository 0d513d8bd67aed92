"""Recording of any robot or program: `Recorder`, the writer of its episodes, and the folder of its run.

with Recorder("runs/mine", robot="so101", cameras={"top": (480, 640)}, fps=30, task="stack the cups") as recorder:
    with recorder.episode() as episode:
        episode.write(observation, action, images)
        episode.success = True
"""

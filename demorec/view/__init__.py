"""Looking at episodes in Rerun: the only part that imports it. Needs no simulator, only the files.

`sources.find_episodes` finds what a path holds, `scene.log_episode` puts an episode into a Rerun recording, `layout`
arranges the views, and `viewer` shows, saves, photographs or serves the result.
"""

"""Playback of episodes in Rerun, which only this package imports. Needs no simulator, only the files.

`sources.find_episodes` lists the episodes of a path, `scene.log_episode` logs an episode to a Rerun recording, `layout`
arranges the views, and `viewer` shows the result or serves it.
"""

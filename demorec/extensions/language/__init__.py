"""Words and numbers derived from a recording: subtasks, plans, memories, motions, wordings, progress and boxes.

Everything is derived from the recording (phases, events, poses, the scene as data); nothing is guessed.
"""

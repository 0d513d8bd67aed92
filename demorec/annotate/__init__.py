"""What a recording's numbers say, in words: subtasks, plans, memories, motions, wordings of the task, and progress.

Everything is derived from what was recorded (phases, events, poses, the scene as data); nothing is guessed.
"""

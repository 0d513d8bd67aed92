"""Recorded actions, simulated again: the proof of a recording.

The world is rebuilt from the recording's own scene, the recorded float64 commands are sent again, and every state on
the way is compared with the recorded one, bit by bit. On one type of machine nothing may differ. The same driver
answers how robust a demonstration is (a lower command rate, noise, delay) and whether an exported dataset, with its
float32 actions of any kind, still does the task.
"""

"""Simulate recorded commands again, as proof of a recording.

The world is rebuilt from the recorded scene, the recorded float64 commands are sent again, and every state is compared
with the recorded one, bit by bit. On one type of machine there must be no difference.
"""

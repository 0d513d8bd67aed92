"""`demorec check --deep`: remake a recording from its own description and compare every byte.

The script runs again from config and seed, so that commands, states, labels, phases, events, calibration, images and
outcome are reproduced; for a derived recording (a replay, a render) the commands are sent again. Differences are
reported by stream, field and frame. It finds every error in a recording of demorec except errors that the program
itself reproduces.
"""

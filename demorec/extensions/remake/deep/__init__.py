"""`demorec check --deep`: a recording made again from its own description, and compared byte by byte.

The script is run again from config and seed, so that commands, states, labels, phases, events, calibration, images
and outcome come out once more; a derived recording (a replay, a rendering) has its commands sent again. What differs
is named by stream, field and frame. So nothing can be wrong with a recording of our own that this does not find,
other than what the program itself does wrong each time.
"""

"""Recordings of collected episodes (`demorec.episode.external`): the same MCAP files, of episodes without our scenes.

with CollectedWriter(path, info) as writer:
    number = writer.picture("top", stamp_ns, pixels)     # or bytes that are coded already
    writer.write(CollectedFrame(time_ns=..., samples=..., pictures={"top": number}))
    writer.finish(CollectedOutcome(success=True, num_frames=1))

with CollectedRecording(path) as recording:
    recording.columns()            # all numbers, their stamps, which pictures the frames hold
    recording.images("top")        # decoded pictures

Both are found in `demorec.mcap`.
"""

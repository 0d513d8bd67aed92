"""Is a collected episode what it says: file, time, age of what the frames hold, numbers, pictures.

What a scene, a seed or a script would say of it nobody knows; the checks that need these are not applicable.
"""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np

from demorec.check.base import Found, Measurement, NotMeasured, check, external_check, worst_frame
from demorec.check.file import complete
from demorec.episode.external import COLLECTED_VERSION, NO_PICTURE
from demorec.mcap import Recording
from demorec.mcap.container import Container
from demorec.mcap.external.streams import SUBTASK
from demorec.mcap.video import decode
from demorec.runs.external import load_external_run
from demorec.runs.run_file import EPISODES, sha256_of

NOT_APPLICABLE = "not applicable: the episode was collected, and this needs the scene of a simulated one"
_NANOSECONDS = 1_000_000_000
_BLANK_LEVELS = 2.0
"""Standard deviation, of 255 levels, below which a picture shows nothing."""
_STILL_FRAMES = 20
"""Of an episode with fewer frames nobody can tell a stuck sensor from a still robot."""


@external_check(
    group="file",
    measures="collected episodes that cannot be opened (index, metadata, format version)",
    reads=("metadata demorec.collected",),
)
def collected_opens(recording: Recording) -> Measurement:
    """The index and the metadata pass their checksums and are of a known format version."""
    return Measurement(value=0, detail=f"format {recording.info.format_version} of {COLLECTED_VERSION}")


@external_check(
    group="file",
    measures="topics whose message count differs from the index; every chunk passes its CRC",
    reads=("metadata demorec.collected",),
)
def collected_checksums(recording: Recording) -> Measurement:
    """Every byte that holds a message passes its checksum, and the index counts the messages right."""
    with closing(Container(recording.path)) as container:
        counts = Counter(message.topic for message in container.messages(tuple(container.channels)))
    wrong = [topic for topic, (_, count) in recording.topics.items() if counts[topic] != count]
    return Measurement(value=len(wrong), detail="; ".join(wrong[:3]) or f"{sum(counts.values())} messages")


@external_check(
    group="file",
    measures="streams that do not decode into numbers, or into words",
    reads=("/frames", "/{feature}", SUBTASK),
)
def collected_readable(recording: Recording) -> Measurement:
    """Every message has the layout that the metadata promises, at its frame's time."""
    said = f", {len(recording.subtasks)} subtasks" if recording.subtasks else ""
    return Measurement(value=0, detail=f"{recording.columns().num_frames} frames{said}")


collected_complete = replace(complete, name="collected_complete", scope="collected")


@external_check(
    group="time",
    measures="frames and pictures that were dropped while recording",
    fail=float("inf"),
    reads=("metadata demorec.outcome",),
)
def collected_drops(recording: Recording) -> Found:
    """What came could be taken."""
    outcome = recording.outcome
    if outcome is None:
        return NotMeasured(why="the recording has no outcome, which would tell")
    lost = ", ".join(f"{count} of {what}" for what, count in outcome.drops.items() if count)
    return Measurement(value=sum(outcome.drops.values()), detail=lost)


@external_check(
    group="time",
    measures="how much the frames' mean rate differs from the nominal one, as a share of it",
    warn=0.05,
    fail=0.5,
    reads=("/frames",),
)
def collected_rate(recording: Recording) -> Found:
    """The frames came at the rate that the episode names, by which datasets and policies go."""
    times, fps = recording.columns().time_ns, recording.info.fps
    if len(times) < 2:
        return None
    rate = (len(times) - 1) * _NANOSECONDS / float(times[-1] - times[0])
    return Measurement(value=abs(rate / fps - 1), detail=f"{rate:.4g} Hz instead of {fps} Hz")


@external_check(
    group="time",
    measures="the longest time between two frames, in nominal periods",
    warn=2.5,
    fail=30,
    reads=("/frames",),
)
def collected_gaps(recording: Recording) -> Found:
    """No frames are missing between others."""
    steps = np.diff(recording.columns().time_ns)
    if not len(steps):
        return None
    frame = int(steps.argmax())
    periods = float(steps[frame]) * recording.info.fps / _NANOSECONDS
    return Measurement(value=periods, frame=frame + 1, detail=f"{steps[frame] / 1e6:.4g} ms after the frame before")


@external_check(
    group="alignment",
    unit="s",
    measures="the largest distance between the stamps of a frame and of a sample that it holds",
    warn=0.1,
    fail=1.0,
    reads=("/frames",),
)
def collected_sample_age(recording: Recording) -> Iterator[Found]:
    """What a frame holds was sensed at about its time."""
    columns = recording.columns()
    for name in columns.stamps:
        yield worst_frame(np.abs(columns.age_ns(name)) / _NANOSECONDS, name)


@external_check(
    group="alignment",
    unit="s",
    measures="the largest distance between the stamps of a frame and of a picture that it holds",
    warn=0.2,
    fail=1.0,
    reads=("/frames", "/camera/{camera}/h264"),
)
def collected_picture_age(recording: Recording) -> Iterator[Found]:
    """The pictures that a frame holds were taken at about its time."""
    columns = recording.columns()
    for camera, numbers in columns.pictures.items():
        frames = np.flatnonzero(numbers != NO_PICTURE)
        yield worst_frame(np.abs(columns.picture_age_ns(camera)) / _NANOSECONDS, f"camera {camera}", frames=frames)


@external_check(
    group="pictures",
    measures="the share of frames that have no picture of a camera",
    fail=0.5,
    reads=("/frames",),
)
def collected_missing_pictures(recording: Recording) -> Iterator[Found]:
    """Every frame has a picture of every camera."""
    for camera, numbers in recording.columns().pictures.items():
        without = np.flatnonzero(numbers == NO_PICTURE)
        if len(numbers):
            first = int(without[0]) if len(without) else None
            told = f"camera {camera}: {len(without)} of {len(numbers)} frames"
            yield Measurement(value=len(without) / len(numbers), frame=first, detail=told)


@external_check(
    group="physics",
    measures="observed features that never change while the actions do",
    fail=1,
    reads=("/{feature}",),
)
def collected_stuck(recording: Recording) -> Found:
    """Sensors are alive: no feature of the observations stays at one value, in all elements, while commands change."""
    features = recording.columns().features
    if recording.columns().num_frames < _STILL_FRAMES:
        return NotMeasured(why=f"the episode has fewer than {_STILL_FRAMES} frames")
    changing = {name for name, values in features.items() if np.ptp(values, axis=0).any()}
    if "action" in features and "action" not in changing:
        return NotMeasured(why="the actions do not change")
    stuck = [name for name in features if name not in changing and name.startswith("observation.")]
    return Measurement(value=len(stuck), detail=", ".join(stuck))


@external_check(
    group="pictures",
    measures="cameras whose pictures do not decode, are of another size, or show one colour, or no distance, in more "
    "than half of them",
    needs_pictures=True,
    reads=("/camera/{camera}/h264", "/camera/{camera}/depth"),
)
def collected_pictures(recording: Recording) -> Found:
    """Every picture decodes and shows something."""
    if not recording.info.cameras:
        return None
    blank, unmeasured = [], []
    for camera in recording.depth_cameras:
        shares = [float(np.mean(np.isfinite(values) & (values > 0))) for values in recording.distances(camera)]
        if shares and float(np.median(shares)) == 0:
            unmeasured.append(camera)
    for camera in recording.cameras:
        images = decode(recording.video_settings(camera), recording.packets(camera))
        deviations = [float(image[::4, ::4].std()) for image in images]
        if deviations and float(np.median(deviations)) < _BLANK_LEVELS:
            blank.append(camera)
    blank += unmeasured
    return Measurement(value=len(blank), detail=", ".join(f"camera {camera} shows nothing" for camera in blank))


@external_check(
    group="pictures",
    measures="pairs of cameras with the same coded pictures",
    reads=("/camera/{camera}/h264",),
)
def collected_distinct_cameras(recording: Recording) -> Found:
    """No two cameras give the very same pictures, as when one is plugged in under two names."""
    digests = dict.fromkeys(recording.cameras, 0)
    for camera in digests:
        for packet in recording.packets(camera):
            digests[camera] = zlib.crc32(packet.data, digests[camera])
    if len(digests) < 2:
        return None
    twins = [[camera for camera in digests if digests[camera] == digest] for digest in set(digests.values()) - {0}]
    pairs = sorted(" and ".join(cameras) for cameras in twins if len(cameras) > 1)
    return Measurement(value=sum(len(cameras) // 2 for cameras in twins), detail="; ".join(pairs))


@check(
    scope="collected_run",
    group="run",
    measures="recordings of a collected run that are missing, unlisted or other files than run.json lists",
    reads=("metadata demorec.collected",),
)
def collected_run_files(folder: Path) -> Measurement:
    """run.json lists exactly the recordings that are there, by their SHA-256."""
    lines = {line.file: line for line in load_external_run(folder).episodes}
    there = {f"{EPISODES}/{file.name}": file for file in (folder / EPISODES).glob("*.mcap")}
    wrong = [f"{name} is missing" for name in lines if name not in there]
    wrong += [f"{name} is not listed" for name in sorted(there) if name not in lines]
    wrong += [
        f"{name} is another file"
        for name, file in there.items()
        if name in lines and sha256_of(file) != lines[name].sha256
    ]
    return Measurement(value=len(wrong), detail="; ".join(wrong[:3]) or f"{len(lines)} episodes")

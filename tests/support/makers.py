"""Makers that stand in for the simulator: the run's machinery is tested in milliseconds, with real processes.

A stand-in recording is a JSON file, a pure function of its plan. Imports little, so that workers start quickly.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import resource
import signal
import time
from pathlib import Path

from demorec.core.config import EpisodePlan, deciding_versions
from demorec.core.errors import RenderError
from demorec.core.files import sha256_of
from demorec.core.plain import digest, to_plain
from demorec.runs.run_file import Attempt, recording_name


def succeeds(seed: int, episode: int, attempt: int) -> bool:
    """About three of four attempts do, as a coin that only depends on which attempt it is."""
    return hashlib.sha256(f"{seed} {episode} {attempt}".encode()).digest()[0] >= 64


def make(plan: EpisodePlan, folder: Path) -> Attempt:
    """A recording, at once."""
    success = succeeds(plan.config.seed, plan.episode_index, plan.attempt)
    name = recording_name(plan.episode_index, plan.attempt, success=success)
    content = {
        "episode_index": plan.episode_index,
        "attempt": plan.attempt,
        "seed": plan.config.seed,
        "success": success,
        "config": to_plain(plan.config),
        "versions": deciding_versions(),
    }
    part = folder / "unfinished" / f"{os.getpid()}-{name}.part"
    part.write_text(json.dumps(content))
    place = folder / ("episodes" if success else "failed") / name
    part.replace(place)
    return line_of(place, content, place.relative_to(folder).as_posix())


def make_slowly(plan: EpisodePlan, folder: Path) -> Attempt:
    """Leaves a part file while it works, for a second."""
    part = folder / "unfinished" / f"{os.getpid()}.part"
    part.write_text("half")
    time.sleep(1.0)
    part.unlink()
    return make(plan, folder)


def make_quickly(plan: EpisodePlan, folder: Path) -> Attempt:
    """Takes long enough to be killed in the middle of."""
    time.sleep(0.03)
    return make(plan, folder)


def make_for_ever(plan: EpisodePlan, folder: Path) -> Attempt:
    """Never ends by itself; a file named after its process tells that it has begun."""
    (folder / "unfinished" / f"busy-{os.getpid()}").touch()
    while True:
        time.sleep(0.05)


def make_stubbornly(plan: EpisodePlan, folder: Path) -> Attempt:
    """Never ends by itself and does not listen."""
    for number in (signal.SIGTERM, signal.SIGUSR1):
        signal.signal(number, signal.SIG_IGN)
    return make_for_ever(plan, folder)


def die_once(plan: EpisodePlan, folder: Path) -> Attempt:
    """The first worker that is given episode 2 is killed."""
    witness = folder / "unfinished" / "witness"
    if plan.episode_index == 2 and not witness.exists():
        witness.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return make(plan, folder)


def die_always(plan: EpisodePlan, folder: Path) -> Attempt:
    """Every worker that is given episode 2 is killed."""
    if plan.episode_index == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return make(plan, folder)


def fill_the_disk(plan: EpisodePlan, folder: Path) -> Attempt:
    """The disk is full at episode 2; the library in between has wrapped the error."""
    if plan.episode_index == 2:
        try:
            raise OSError(errno.ENOSPC, "No space left on device")
        except OSError as error:
            raise RuntimeError("the writer failed") from error
    return make(plan, folder)


def write_too_much(plan: EpisodePlan, folder: Path) -> Attempt:
    """Episode 2 is larger than the limit of this process (ulimit -f) allows a file to be."""
    if plan.episode_index == 2:
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
        (folder / "unfinished" / "large.part").write_bytes(bytes(2000))
    return make(plan, folder)


def break_the_disk(plan: EpisodePlan, folder: Path) -> Attempt:
    """The disk cannot write episode 2, however often it is tried."""
    if plan.episode_index == 2:
        raise OSError(errno.EIO, "Input/output error")
    return make(plan, folder)


def lose_the_folder(plan: EpisodePlan, folder: Path) -> Attempt:
    """The folder is moved away by somebody at episode 2."""
    if plan.episode_index == 2:
        folder.rename(folder.with_name("elsewhere"))
    return make(plan, folder)


def flicker(plan: EpisodePlan, folder: Path) -> Attempt:
    """The network file system has a bad moment at episode 2."""
    witness = folder / "unfinished" / "witness"
    if plan.episode_index == 2 and not witness.exists():
        witness.touch()
        raise OSError(errno.EIO, "Input/output error")
    return make(plan, folder)


def raise_a_bug(plan: EpisodePlan, folder: Path) -> Attempt:
    """Somebody's task has a bug, with an exception that cannot be pickled."""

    class LocalError(Exception):
        pass

    if plan.episode_index == 2:
        raise LocalError("the cube is a sphere")
    return make(plan, folder)


def raise_ours(plan: EpisodePlan, folder: Path) -> Attempt:
    """A renderer that does not work here."""
    raise RenderError("No OpenGL library was found.")


def report_pid(plan: EpisodePlan, folder: Path) -> Attempt:
    """Leaves a file named after its process and the threads that it would use."""
    (folder / "unfinished" / f"pid-{os.getpid()}-{os.environ.get('OMP_NUM_THREADS')}").touch()
    return make(plan, folder)


def line_of(path: Path, content: dict[str, object], file: str) -> Attempt:
    """The line of run.json of a stand-in recording."""
    return Attempt(
        episode_index=int(str(content["episode_index"])),
        attempt=int(str(content["attempt"])),
        seed=int(str(content["seed"])),
        success=bool(content["success"]),
        file=file,
        sha256=sha256_of(path),
        digest=digest({k: v for k, v in content.items() if k != "versions"}),
        num_frames=7,
        num_bytes=path.stat().st_size,
        phase="" if content["success"] else "lift",
        reason="" if content["success"] else "dropped",
        seconds={"simulation": 0.25},
    )

"""Makers that replace the simulator: runs are tested in milliseconds, with real processes.

A stand-in recording is a JSON file, a pure function of its plan. Imports little, so that workers start quickly.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import signal
import time
from pathlib import Path

from demorec.core.config import EpisodePlan, deciding_versions
from demorec.core.errors import RenderError
from demorec.core.files import sha256_of
from demorec.core.plain import digest, to_plain
from demorec.runs.run_file import Attempt, recording_name


def succeeds(seed: int, episode: int, attempt: int) -> bool:
    """Whether an attempt succeeds: about three of four do, by a coin toss that depends only on the attempt."""
    return hashlib.sha256(f"{seed} {episode} {attempt}".encode()).digest()[0] >= 64


def make(plan: EpisodePlan, folder: Path) -> Attempt:
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
    """Keep a part file for a second, as if working."""
    part = folder / "unfinished" / f"{os.getpid()}.part"
    part.write_text("half")
    time.sleep(1.0)
    part.unlink()
    return make(plan, folder)


def make_for_ever(plan: EpisodePlan, folder: Path) -> Attempt:
    """Never end; a file named after the process marks the beginning."""
    (folder / "unfinished" / f"busy-{os.getpid()}").touch()
    while True:
        time.sleep(0.05)


def make_stubbornly(plan: EpisodePlan, folder: Path) -> Attempt:
    """Never end, and ignore signals."""
    for number in (signal.SIGTERM, signal.SIGUSR1):
        signal.signal(number, signal.SIG_IGN)
    return make_for_ever(plan, folder)


def die_once(plan: EpisodePlan, folder: Path) -> Attempt:
    """Die in the first worker that gets episode 2."""
    witness = folder / "unfinished" / "witness"
    if plan.episode_index == 2 and not witness.exists():
        witness.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return make(plan, folder)


def die_always(plan: EpisodePlan, folder: Path) -> Attempt:
    if plan.episode_index == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return make(plan, folder)


def fill_the_disk(plan: EpisodePlan, folder: Path) -> Attempt:
    """Fail at episode 2 because the disk is full, with the error wrapped by a library."""
    if plan.episode_index == 2:
        try:
            raise OSError(errno.ENOSPC, "No space left on device")
        except OSError as error:
            raise RuntimeError("the writer failed") from error
    return make(plan, folder)


def break_the_disk(plan: EpisodePlan, folder: Path) -> Attempt:
    """Fail to write episode 2, at every attempt."""
    if plan.episode_index == 2:
        raise OSError(errno.EIO, "Input/output error")
    return make(plan, folder)


def lose_the_folder(plan: EpisodePlan, folder: Path) -> Attempt:
    """Move the folder away at episode 2, as a user might."""
    if plan.episode_index == 2:
        folder.rename(folder.with_name("elsewhere"))
    return make(plan, folder)


def flicker(plan: EpisodePlan, folder: Path) -> Attempt:
    """Fail once at episode 2, like an unreliable network file system."""
    witness = folder / "unfinished" / "witness"
    if plan.episode_index == 2 and not witness.exists():
        witness.touch()
        raise OSError(errno.EIO, "Input/output error")
    return make(plan, folder)


def raise_a_bug(plan: EpisodePlan, folder: Path) -> Attempt:
    """Raise an exception that cannot be pickled, as from a bug in a user's task."""

    class LocalError(Exception):
        pass

    if plan.episode_index == 2:
        raise LocalError("the cube is a sphere")
    return make(plan, folder)


def raise_ours(plan: EpisodePlan, folder: Path) -> Attempt:
    """Raise the error of a renderer that does not work here."""
    raise RenderError("No OpenGL library was found.")


def report_pid(plan: EpisodePlan, folder: Path) -> Attempt:
    """Leave a file named after the process and its number of threads."""
    (folder / "unfinished" / f"pid-{os.getpid()}-{os.environ.get('OMP_NUM_THREADS')}").touch()
    return make(plan, folder)


def line_of(path: Path, content: dict[str, object], file: str) -> Attempt:
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
        seconds=0.25,
    )

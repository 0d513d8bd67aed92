"""Check a dataset that demorec wrote against its sidecar: instruction, outcome and content of each episode."""

from __future__ import annotations

import reprlib
from collections.abc import Iterator

from demorec.check.base import Checkable, Fault, NotApplicableError, check, listed
from demorec.check.dataset import CheckedDataset
from demorec.datasets.episode import SUCCESS
from demorec.datasets.lerobot.inspect import episode_digests


@check(
    family="files",
    on=("dataset",),
    needs="demorec's sidecar",
    measures="episodes that differ from their sidecar entry",
    why="The dataset differs from the export.",
    do="export it again",
)
def dataset_sidecar(subject: Checkable) -> Iterator[Fault]:
    """Compare instruction, outcome and content digest of each episode with the sidecar."""
    dataset = CheckedDataset(subject.path)
    if not dataset.records:
        raise NotApplicableError("another program wrote the dataset")
    count = len(dataset.listed)
    known = [row["episode_index"] for row in dataset.records]
    if sorted(set(known)) != known or not set(known) <= set(range(count)):
        return listed([f"its rows have the episodes {reprlib.repr(known)}, the dataset has {count}"])
    missing = sorted(set(range(count)) - set(known))
    wrong = [f"episode {number} is unknown, perhaps recorded with LeRobot's resume" for number in missing]
    infos = {each.number: each.info for each in dataset.described()}
    digests = dict(zip(dataset.numbers, episode_digests(dataset, list(dataset.numbers)), strict=True))
    for row in dataset.records:
        number = row["episode_index"]
        if (rows := dataset.numbers.get(number)) is None:
            continue
        if number in infos and dataset.listed[number].tasks != (infos[number].instruction,):
            wrong.append(f"episode {number} has another instruction")
        # null: unknown, as for a part of an episode
        elif SUCCESS in rows and bool(rows[SUCCESS][-1, 0]) != bool(row["success"]):
            wrong.append(f"episode {number} has another outcome")
        elif digests[number] != row["content_digest"]:
            wrong.append(f"episode {number} has changed since it was exported")
    return listed(wrong)

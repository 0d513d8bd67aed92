"""Check a dataset that demorec wrote against its sidecar: instruction, outcome and content of each episode."""

from __future__ import annotations

import reprlib

from demorec.check.base import Measurement, counted, dataset_check
from demorec.check.dataset import CheckedDataset
from demorec.datasets.episode import SUCCESS
from demorec.datasets.lerobot.inspect import episode_digests


@dataset_check(measures="episodes unlike their entry in the sidecar", needs="the sidecar that demorec keeps")
def dataset_sidecar(dataset: CheckedDataset) -> Measurement | None:
    """Compare instruction, outcome and content digest of each episode with the sidecar."""
    if not dataset.sidecar:
        return None
    count = len(dataset.folder.listed)
    known = [row["episode_index"] for row in dataset.sidecar]
    if sorted(set(known)) != known or not set(known) <= set(range(count)):
        return Measurement(value=1, detail=f"its rows are of the episodes {reprlib.repr(known)}, there are {count}")
    missing = sorted(set(range(count)) - set(known))
    wrong = [f"episode {number} is unknown, as one that LeRobot recorded with resume" for number in missing]
    infos = {each.number: each.info for each in dataset.described()}
    digests = dict(zip(dataset.rows, episode_digests(dataset.folder, list(dataset.rows)), strict=True))
    for row in dataset.sidecar:
        number = row["episode_index"]
        if (rows := dataset.rows.get(number)) is None:
            continue
        if number in infos and dataset.folder.listed[number].tasks != (infos[number].instruction,):
            wrong.append(f"episode {number} has another instruction")
        elif SUCCESS in rows and bool(rows[SUCCESS][-1, 0]) != bool(row["success"]):  # null: unknown, as of a part
            wrong.append(f"episode {number} has another outcome")
        elif digests[number] != row["content_digest"]:
            wrong.append(f"episode {number} has changed since it was exported")
    return counted(wrong, f"{len(known)} episodes")

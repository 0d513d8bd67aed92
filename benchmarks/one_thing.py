"""pick_anything with a single object, whose pose and extents a policy gets as numbers: does it generalise to new
objects?

    cd benchmarks; flags="--task one_thing:OneThing --split train --object-split train --cameras none --no-export"
    generate-dataset $flags --num-episodes 500 --out ../outputs/things
    demorec export lerobot ../outputs/things --out ../outputs/things/policy_data --repo-id me/things --privileged \
        --features observation.environment_state --action ee_delta
    lerobot-train-fast --config_path=../examples/act_numbers.json --dataset.root=../outputs/things/policy_data \
        --dataset.repo_id=me/things --steps=5000 --scheduler.num_decay_steps=5000 --output_dir=../outputs/act_things
    for split in train eval; do demorec evaluate --policy ../outputs/act_things --task one_thing:OneThing \
        --object-split $split --num-episodes 100 --allow one_thing --out ../outputs/on_$split; done

Both evaluations put the object where no demonstration had it; `eval` also uses shapes that no demonstration had.
"""

from __future__ import annotations

from dataclasses import replace

from demorec.extensions.tasks.anything import PickAnything
from demorec.tasks.base import Layout
from demorec.tasks.sampling import Sampler


class OneThing(PickAnything):
    """`PickAnything` with one object on the table, which is called "thing".

    Its yaw is given modulo half a turn, since two fingers cannot distinguish more.
    """

    summary = "a single object to a mark, a tray, a bowl or a plate"

    def layout(self, sampler: Sampler) -> Layout:
        """Draw it."""
        (target, wanted, *_), (goal,) = super().layout(sampler)
        return [target, replace(wanted, name="thing", color_name="", yaw_symmetry=2)], [replace(goal, object="thing")]

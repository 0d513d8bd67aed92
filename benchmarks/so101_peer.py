"""SO-101 pick-and-place beside lerobot-env-so101's: success by its conditions and by ours, CPU time, without images.

    python -m venv peer && peer/bin/pip install lerobot-env-so101==0.4.0
    python benchmarks/so101_peer.py --peer peer/bin/python --episodes 300

Each scripts its own scenes: there one block of 40 mm, always parallel to the axes, at 10 control steps a second and by
increments of the hand; here cubes of 11 to 23 mm of any yaw, mass and friction (`--variation mild`) at 30, by joints.

Its conditions: the block was 3 cm up, lies within 3 cm of its goal, slower than 1 cm/s, the jaw more than half open.
Ours: those of pick_place, in the frame in which the script ends.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import time
from typing import Any

CARRIED_M, NEAR_M, SLOW_M_S, OPEN_SHARE = 0.03, 0.03, 0.01, 0.5
"""Its conditions."""


def peer(episodes: int) -> dict[str, Any]:
    """Runs in the other environment, which has no demorec."""
    import gymnasium
    import lerobot_env_so101  # noqa: F401  # registers the environment
    import mujoco
    import numpy as np
    from lerobot_env_so101.gripper import ctrl_to_normalized
    from lerobot_env_so101.policy import DEFAULT_ACTION_SCALE
    from lerobot_env_so101.scripted import PickPlaceController
    from lerobot_env_so101.scripted.reach_close import GRIPPER_OPEN

    env = gymnasium.make(
        "lerobot_env_so101/SO101PickPlace-v0",
        random_block_position=True,
        action_scale=DEFAULT_ACTION_SCALE,
        max_episode_steps=400,
    ).unwrapped
    model, data = env._model, env._data
    block, body = model.geom("block").id, model.body("block").id
    dof, jaw = model.joint("block").dofadr[0], model.joint("gripper").qposadr[0]
    world = {geom for geom in range(model.ngeom) if model.geom_bodyid[geom] == 0}
    controller, rows = PickPlaceController(), []
    env.reset(seed=0)
    started = time.process_time()
    for seed in range(episodes):
        env.reset(seed=seed)
        controller.reset()
        height, by_its_own, steps = float(data.xpos[body][2]), False, 0
        while not controller.done and steps < 400:
            place = data.sensor("block_pos").data
            _, _, _, _, about = env.step(controller.act(env.ik_point_pos, place, env.goal_pos))
            by_its_own, steps = by_its_own or about["succeed"], steps + 1
        velocity = data.qvel[dof : dof + 6]
        opening = ctrl_to_normalized(data.qpos[jaw], model.actuator("gripper").ctrlrange)
        touching = any(
            block in (contact.geom1, contact.geom2) and not {contact.geom1, contact.geom2} - {block} <= world
            for contact in data.contact[: data.ncon]
        )
        rotation = data.xmat[body].reshape(3, 3)
        off = math.dist(data.xpos[body][:2], env.goal_pos[:2])
        values = {
            "distance_to_goal": off,
            "height_error": abs(float(data.xpos[body][2]) - height),
            "tilt": math.acos(min(1.0, float(np.abs(rotation[2]).max()))),
            "speed": math.hypot(*velocity[:3]),
            "spin": math.hypot(*velocity[3:]),
            "touched_by_robot": float(touching),
            "gripper_width": float(opening) / GRIPPER_OPEN,
        }
        rows.append({"own": bool(by_its_own), "values": values, "steps": steps})
    mujoco.mj_resetData(model, data)
    return {"rows": rows, "cpu_s": time.process_time() - started}


def ours(episodes: int) -> dict[str, Any]:
    """The scripted expert, as `benchmarks/success.py` runs it."""
    from demorec.core.config import EpisodePlan, GenerateConfig
    from demorec.loop import ScriptAgent, Session, make_world, prepare

    config = GenerateConfig(task="pick_place", robot="so101", variation="mild", cameras=())
    rows = []
    with make_world(prepare(EpisodePlan(config=config, episode_index=0)).info) as world:
        for number in range(-1, episodes):  # one to compile the kinematics
            if number == 0:
                started = time.process_time()
            episode = prepare(EpisodePlan(config=config, episode_index=max(number, 0)))
            session = Session.of_episode(world, episode)
            name = episode.info.scene.goals[0].object
            heights = [frame.observation.object_poses[name].position[2] for frame in session.run(ScriptAgent(episode))]
            values = {check.name: check.value for check in session.outcome.checks}
            own = (
                max(heights) - heights[0] > CARRIED_M
                and values["distance_to_goal"] < NEAR_M
                and values["speed"] < SLOW_M_S
                and values["gripper_width"] > OPEN_SHARE * world.robot.gripper.open_width
            )
            rows.append({"own": own, "strict": session.outcome.success, "values": values, "steps": len(heights)})
        seconds = time.process_time() - started
    return {"rows": rows[1:], "cpu_s": seconds}


def is_strict(values: dict[str, float]) -> bool:
    """Whether our conditions hold of what the peer's episode ended in; its opening is a share of what it asks for."""
    from demorec.episode.conditions import LIMITS

    return all(
        value <= limit if side == "at most" else value >= limit
        for name, value in values.items()
        for side, limit in (LIMITS[name],)
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--peer", required=True, help='Python of its environment; "this" runs it in here')
    parser.add_argument("--episodes", type=int, default=300)
    args = parser.parse_args()
    if args.peer == "this":
        print(json.dumps(peer(args.episodes)))
        return
    command = [args.peer, __file__, "--peer", "this", "--episodes", str(args.episodes)]
    theirs = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)
    for row in theirs["rows"]:
        row["strict"] = is_strict(row["values"])
    print("| script | its conditions | ours | mm from goal (median / max) | steps | CPU s an episode |")
    print("|---|---|---|---|---|---|")
    for name, found in (("lerobot-env-so101", theirs), ("demorec", ours(args.episodes))):
        rows = found["rows"]
        off = sorted(1000 * row["values"]["distance_to_goal"] for row in rows)
        own, strict = (sum(row[kind] for row in rows) for kind in ("own", "strict"))
        print(
            f"| {name} | {own}/{len(rows)} | {strict}/{len(rows)} "
            f"| {off[len(off) // 2]:.2f} / {off[-1]:.2f} | {sum(row['steps'] for row in rows) / len(rows):.0f} "
            f"| {found['cpu_s'] / len(rows):.3f} |",
            flush=True,
        )
    missed = [name for row in theirs["rows"] if not row["strict"] for name in failed(row["values"])]
    print(f"Where the peer misses ours: { {name: missed.count(name) for name in sorted(set(missed))} }")


def failed(values: dict[str, float]) -> list[str]:
    """Which of our conditions do not hold."""
    return [name for name in values if not is_strict({name: values[name]})]


if __name__ == "__main__":
    main()

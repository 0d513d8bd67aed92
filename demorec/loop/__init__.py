"""The closed loop, the only place that steps a world: an agent decides, a session executes and yields frames.

    episode = prepare(EpisodePlan(config=GenerateConfig(), episode_index=0))  # info, task, behaviour; no simulator
    with SimulatorCache() as simulators:
        world, renderer = simulators.acquire(episode.info)  # both are reused; no renderer without cameras
        session = Session.of_episode(world, episode, renderer)
        for frame in session.run(ScriptAgent(episode)):  # the world is reset here, then one control step a frame
            print(frame.frame_index, frame.phase, frame.observation.gripper_width)
        print(session.outcome)

Its callers are generation, replay and the gymnasium environment that evaluates policies. An episode is a pure function
of its plan: its bits depend neither on the worker nor on earlier runs in the same world.
"""

from demorec.loop.prepare import PreparedEpisode, SimulatorCache, load_task, make_world, prepare
from demorec.loop.session import Agent, ScriptAgent, Session
from demorec.tasks.script import Step

__all__ = [
    "Agent",
    "PreparedEpisode",
    "ScriptAgent",
    "Session",
    "SimulatorCache",
    "Step",
    "load_task",
    "make_world",
    "prepare",
]

"""Which of the vectors in a bag become the state and the action of a suggested mapping."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from demorec.sources.candidates import Vector

_SIDES = {"left", "right", "l", "r"}
_QUANTITIES = {
    "joint",
    "joints",
    "position",
    "positions",
    "pos",
    "velocity",
    "velocities",
    "cartesian",
    "torque",
    "pose",
}


def choose_features(vectors: Sequence[Vector]) -> tuple[list[Vector], list[Vector], list[Vector], str]:
    """The parts of the state and of the action: joints if there are any, otherwise poses and velocities in space.

    Returns:
        The state, the action (empty: it is the next state), all other vectors, and a warning that the robot's arm is
        not among the parts, "" where it is.
    """
    usable = [vector for vector in vectors if vector.is_sure and vector.rate_hz and vector.kind != "numbers"]
    measured = [vector for vector in usable if vector.role != "action"]
    commands = [vector for vector in usable if vector.role == "action"]
    state = _joints([vector for vector in measured if vector.role == "state"])
    unsaid = [vector for vector in measured if vector.kind == "arm" and not vector.role]
    robots = {tuple(word for word in vector.words if word not in _SIDES) for vector in unsaid}
    if len(robots) == 1 and not _has(state, "arm"):
        state = [*unsaid, *state]
    has_arm = _has(state, "arm")
    if all(vector.kind == "gripper" or vector.has_wheels for vector in state):
        state = sorted([*state, *_of_robot(measured)], key=lambda vector: vector.kind == "gripper")
    action = _joints(commands)
    if not has_arm and not _has(action, "arm"):
        action = [*(vector for vector in commands if vector.kind in ("pose", "twist")), *action]
    warning = ""
    if all(vector.kind == "gripper" for vector in state):
        warning = _lacking(state, vectors)
        state = []
    elif all(vector.kind == "gripper" for vector in action):
        action = []  # the arm's command is missing, and the next state has the gripper's opening as well
    taken = {id(vector) for vector in (*state, *action)}
    return state, action, [vector for vector in vectors if id(vector) not in taken], warning


def _lacking(grippers: Sequence[Vector], vectors: Sequence[Vector]) -> str:
    found = "no topic is known to say what the robot does"
    if grippers:
        labels = [label for vector in grippers for label in vector.labels]
        found = f"the only joints that are known to be measured are a gripper's ({', '.join(labels[:4])})"
    advice = (
        "take the topics that do from the lines that are commented out" if vectors else "the bag has none of numbers"
    )
    return f"The arm is left out: {found}. The import refuses this mapping as it is: {advice}."


def _has(vectors: Iterable[Vector], kind: str) -> bool:
    return any(vector.kind == kind for vector in vectors)


def _joints(vectors: Sequence[Vector]) -> list[Vector]:
    """The joints among them, none twice: those of arms and bases, then those of grippers."""
    bodies = _distinct([vector for vector in vectors if vector.kind in ("arm", "base")])
    grippers = [vector for vector in vectors if vector.kind == "gripper"]
    if any(vector.has_gripper for vector in bodies):
        known = {label for vector in bodies for label in vector.labels}
        grippers = [vector for vector in grippers if vector.reader.joints and not known & set(vector.labels)]
    return [*bodies, *_distinct(grippers)]


def _distinct(vectors: Sequence[Vector]) -> list[Vector]:
    """Those that say something else than the others, in the order given."""
    chosen: list[Vector] = []
    for vector in sorted(vectors, key=_rank):
        if not any(_are_same(vector, other) for other in chosen):
            chosen.append(vector)
    return sorted(chosen, key=vectors.index)


def _rank(vector: Vector) -> tuple[bool, bool, bool, int, int]:
    is_named = bool(vector.reader.joints)
    return not vector.is_leader, not is_named, vector.is_other, -len(vector.labels), len(vector.words)


def _are_same(one: Vector, other: Vector) -> bool:
    """Whether two vectors are likely the same joints sent twice: a relay, a merged topic, a driver's own message."""
    if one.topic == other.topic:
        return False
    joints, others = set(one.reader.joints), set(other.reader.joints)
    if joints and others and not joints & others:
        return False
    # Two arms have topics of the same kind that differ by a word each: left and right, 1 and 2; so do two quantities.
    only, only_other = {*one.words} - {*other.words}, {*other.words} - {*one.words}
    are_pair = bool(only and only_other) and not (only | only_other) & _QUANTITIES
    are_alike = (one.type, one.field, one.is_leader, joints) == (other.type, other.field, other.is_leader, others)
    return not (are_pair and are_alike)


def _of_robot(measured: Sequence[Vector]) -> list[Vector]:
    """Poses and velocities of a robot, or the only ones that there are."""
    found = [vector for vector in measured if vector.kind in ("pose", "twist")]
    named = [vector for vector in found if vector.is_robot]
    return named or (found if len({vector.topic for vector in found}) == 1 else [])

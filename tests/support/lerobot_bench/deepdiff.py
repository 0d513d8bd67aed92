"""Stand-in for the package deepdiff, with which LeRobot's bus compares the registers of its servos."""


def DeepDiff(one: object, other: object) -> dict[str, object]:
    return {} if one == other else {"values_changed": other}

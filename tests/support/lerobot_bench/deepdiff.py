"""In place of the package deepdiff, by which LeRobot's bus asks whether its servos have the same registers."""


def DeepDiff(one: object, other: object) -> dict[str, object]:
    return {} if one == other else {"values_changed": other}

"""In place of the package deepdiff, which compares servos of different models."""


class DeepDiff:
    pass

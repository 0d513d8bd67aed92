"""Errors that the commands report as one sentence."""

from __future__ import annotations


class TrainingError(Exception):
    """Training failed, or a file is damaged. The command returns `exit_code`."""

    exit_code = 1


class RequestError(TrainingError):
    """The request is wrong: an impossible value, a missing file, an unsuitable dataset or folder."""

    exit_code = 2

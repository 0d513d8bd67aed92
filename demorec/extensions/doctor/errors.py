"""Reasons why a check of the doctor cannot judge."""

from __future__ import annotations


class NotMeasuredError(Exception):
    """A check cannot judge this evidence; the text gives the reason."""


class NotApplicableError(NotMeasuredError):
    """A check is about other kinds of data, or was not requested."""

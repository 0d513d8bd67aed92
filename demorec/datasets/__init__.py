"""Shared parts of the exporters: selection of recordings, their numbers, common options, atomic output."""

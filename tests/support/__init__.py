"""Helpers for several tests: synthetic recordings, runs and datasets, readers, commands."""

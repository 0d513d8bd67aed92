"""Shared parts of the commands: flags and their files, output to a terminal, and progress."""

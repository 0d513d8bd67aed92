"""Abilities beyond making, recording, playing back and exporting: one folder each, which can be deleted."""

"""Policies: evaluation in held-out scenes, and correction by the expert."""

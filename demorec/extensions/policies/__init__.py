"""Closed-loop runs of a policy in held-out scenes: its success rate with an interval, and corrections by the expert."""

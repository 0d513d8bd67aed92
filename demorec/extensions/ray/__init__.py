"""Generation on a Ray cluster."""

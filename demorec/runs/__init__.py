"""A run on disk: its run.json, its lock, its recordings."""

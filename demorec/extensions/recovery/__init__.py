"""Recovery of recordings that a crash cut off or damaged."""

"""Words for the objects of a scene: colours and containers."""

COLOR_WORDS = ("red", "green", "blue", "yellow", "orange", "purple", "black", "white", "grey")
"""Words for colours in instructions and names."""
VESSELS = ("tray", "bowl")
"""Nouns of containers, which take "in" and "into" instead of "on" and "onto"."""

"""Import of third-party robots' episodes: bags are read, mapped to features, aligned to one clock and recorded.

    bag files -> messages -> streams (mapping) -> rows (clock) -> episodes, with a report of all findings

Nothing is invented: a row holds messages of the bag and records their age.
"""

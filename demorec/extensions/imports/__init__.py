"""Episodes of other people's robots: bags are read, mapped to features, brought to one clock and recorded.

    bag files -> messages -> streams (mapping) -> rows (clock) -> episodes, with a report of all that was found

Nothing is invented: a row holds messages that are in the bag, and says how old they are.
"""

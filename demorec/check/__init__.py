"""Check the integrity of recordings, runs and datasets. One check per function, each with its limits; none needs the
simulator.
"""

"""The simulated world: the only importer of PyBullet."""

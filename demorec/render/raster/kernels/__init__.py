"""The inner loops, compiled with numba; all other code is NumPy and plain Python."""

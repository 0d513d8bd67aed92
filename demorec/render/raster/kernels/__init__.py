"""The inner loops, compiled with numba; everything around them is NumPy and plain Python."""

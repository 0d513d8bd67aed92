"""Further tasks, and the objects that they draw: families of tasks, one file each."""

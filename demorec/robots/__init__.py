"""Robots as data, and the mathematics of arms: URDF, kinematics, grippers; one file per included arm."""

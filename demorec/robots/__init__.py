"""Robots as data, and the mathematics of arms: URDF, kinematics, grippers; a file for each arm that comes along."""

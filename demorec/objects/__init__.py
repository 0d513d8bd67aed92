"""Objects to handle: sets of shapes, and grasps for any of them."""

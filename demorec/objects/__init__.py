"""Things to handle: shelves of shapes, and where a gripper takes hold of any of them."""

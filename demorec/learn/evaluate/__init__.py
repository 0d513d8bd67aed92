"""Does the data teach? A policy in closed loop over held-out scenes, with how sure its success rate is."""

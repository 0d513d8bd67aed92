"""Editing of LeRobot datasets, whoever wrote them: what is to be kept is planned first, then written in one pass."""

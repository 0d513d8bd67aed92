"""What is described as plain data: scenes, robots, episodes, features, and the mathematics of arms."""

from demorec.scene.robot import RobotSpec
from demorec.scene.scene import Body, Camera, Goal, Light, Physics, RobotPlacement, Scene, Shape, Texture

__all__ = ["Body", "Camera", "Goal", "Light", "Physics", "RobotPlacement", "RobotSpec", "Scene", "Shape", "Texture"]

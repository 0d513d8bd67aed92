"""One simulated world, built from a `Scene` alone and stepped by commands.

An episode is a pure function of scene and commands: each reset rebuilds everything in a fixed order and sets every
engine parameter (PyBullet leaks some of them into later clients of the process).
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from demorec.core.errors import ConfigError, SceneError
from demorec.core.files import Closing
from demorec.core.geometry import Array, Pose
from demorec.episode.episode import Action, JointSample, Observation, frame_time_ns
from demorec.episode.scene import Body, Physics, Scene
from demorec.render import Mount, VisualBody
from demorec.robots.robot import RobotSpec
from demorec.sim.arm import Arm
from demorec.sim.bodies import add_body, base_from_inertial, body_poses, visual_bodies
from demorec.sim.client import connect
from demorec.sim.sensors import SENSORS

SETTLE_SECONDS = 0.1
"""Physics time before the first frame, so that objects rest on their support."""
MAX_PRESS_FORCE = 100.0
"""Maximum force, N, with which a real hand presses on an object."""
MAX_PRESS_DEPTH = 1e-3
"""Maximum depth, metres, to which a link of a real hand sinks into an object."""
HULL_MARGIN = 1e-3
"""Margin of Bullet's hull around a mesh, metres; boxes and cylinders have their margin inside."""


class World(Closing):
    """A PyBullet client with one robot and the bodies of a scene; a context manager, reused across episodes.

    Args:
        robot: The arm.
        fps: Control steps per second; divides the scene's physics rate.
        sample_joints: Whether `apply` keeps the joint states of every physics step (see `joint_samples`).

    Attributes:
        inertial_poses: Body of the scene -> pose of its centre of mass in its own frame.
    """

    def __init__(self, robot: RobotSpec, *, fps: int = 30, sample_joints: bool = False) -> None:
        self.robot = robot
        self.fps = fps
        self.client: Any = connect()
        self.joint_samples: tuple[JointSample, ...] = ()
        """Joint states of the last control step, first and last excluded."""
        self._sample_joints = sample_joints
        self._scene: Scene | None = None
        self._visuals: tuple[VisualBody, ...] = ()
        self.inertial_poses: dict[str, Pose] = {}

    def close(self) -> None:
        """Free the client; safe to call twice."""
        self.client.disconnect()

    @property
    def scene(self) -> Scene:
        """Scene of the last reset."""
        if self._scene is None:
            raise RuntimeError("the world is empty: call reset first")
        return self._scene

    def reset(self, scene: Scene) -> None:
        """Empty the world, build `scene` and let it settle for 0.1 s.

        Raises:
            SceneError: A model file is missing or broken, two bodies share a name, or the scene has a different robot.
            ConfigError: The frame rate does not divide the physics rate.
        """
        if scene.robot.name != self.robot.name:
            raise SceneError(f"The scene is for the robot {scene.robot.name!r}, the world has {self.robot.name!r}.")
        names = [body.name for body in scene.bodies]
        if len(set(names)) != len(names):
            raise SceneError(f"Two bodies of the scene share a name: {', '.join(sorted(names))}.")
        if scene.physics.hz % self.fps:
            raise ConfigError(f"fps is {self.fps}, which does not divide the physics rate of {scene.physics.hz} Hz.")
        self._scene = scene
        self._substeps = scene.physics.hz // self.fps
        self._steps = 0
        self.joint_samples = ()
        self._visuals = ()
        self.client.resetSimulation()
        set_engine(self.client, scene.physics)
        self._iterations = scene.physics.solver_iterations
        self._bodies: dict[str, int] = {}
        self._specs: dict[str, Body] = {body.name: body for body in scene.bodies}
        self._quats: dict[str, Array] = {}
        for body in scene.fixed:
            self._bodies[body.name] = add_body(self.client, body)
        self.arm = Arm(self.client, self.robot, scene.robot, finger_stiffness=scene.physics.finger_stiffness)
        for body in scene.movable:
            self._bodies[body.name] = add_body(self.client, body)
        self.inertial_poses = {name: base_from_inertial(self.client, index) for name, index in self._bodies.items()}
        self._constraint: int | None = None
        self.arm.command_gripper(self.arm.gripper_target)
        for _ in range(round(SETTLE_SECONDS * scene.physics.hz)):
            self.arm.drive(self.arm.target)
            self.client.stepSimulation()

    def hold(self) -> Action:
        """Build the command that keeps the current targets."""
        return self.arm.action(self.arm.target.copy(), self.arm.gripper_target)

    def apply(self, command: Action) -> None:
        """Advance by one control step; the joint targets move linearly from the last command to this one."""
        start, end = self.arm.target, np.asarray(command.joint_target, dtype=np.float64)
        if self.scene.hold == "constraint":
            self._hold_by_constraint(command)
        self.arm.command_gripper(command.gripper_target)
        samples = []
        for substep in range(1, self._substeps + 1):
            self.arm.drive(start + (end - start) * (substep / self._substeps))
            self._set_iterations()
            self.client.stepSimulation()
            if self._sample_joints and substep < self._substeps:
                position, velocity, effort = self.arm.joint_states()
                samples.append(
                    JointSample(
                        time_ns=frame_time_ns(self._steps * self._substeps + substep, self.scene.physics.hz),
                        joint_position=position,
                        joint_velocity=velocity,
                        joint_effort=effort,
                    )
                )
        self._steps += 1
        self.joint_samples = tuple(samples)
        self.arm.target = end.copy()

    def _hold_by_constraint(self, command: Action) -> None:
        """Fix a body to the hand once both closing fingers press on it, until a command opens the gripper.

        A shortcut of many PyBullet tutorials that replaces friction. It depends only on the world's state and the
        commands, so that a recording replays without storing when the constraint was made.
        """
        arm, client = self.arm, self.client
        if command.gripper_target > arm.gripper_target + 1e-6:
            if self._constraint is not None:
                client.removeConstraint(self._constraint)
                self._constraint = None
            return
        # Fingers that have not yet left an object do not close.
        if self._constraint is not None or command.gripper_target >= arm.gripper_width():
            return
        for index in (self._bodies[body.name] for body in self.scene.movable):
            if all(client.getContactPoints(arm.body, index, link, -1) for link in arm.finger_links):
                tcp = arm.links[self.robot.tcp_link]
                hand = client.getLinkState(arm.body, tcp, computeForwardKinematics=True)
                place = client.getBasePositionAndOrientation(index)
                # The constraint's frames are at the centres of mass: [0:2] of a link state.
                position, quat = client.multiplyTransforms(*client.invertTransform(*hand[0:2]), *place)
                self._constraint = client.createConstraint(
                    arm.body, tcp, index, -1, client.JOINT_FIXED, [0, 0, 0], position, [0, 0, 0], quat
                )
                return

    def _set_iterations(self) -> None:
        """Set more solver iterations while the fingers hold a body; the default lets them sink deep into light objects.

        Bullet finds contacts before bodies touch, so the contacts of the last step are early enough.
        """
        physics = self.scene.physics
        if not physics.grip_iterations:
            return
        contacts = (self.client.getContactPoints(self.arm.body, -1, link) for link in self.arm.finger_links)
        wanted = physics.grip_iterations if any(contacts) else physics.solver_iterations
        if wanted != self._iterations:
            self.client.setPhysicsEngineParameter(numSolverIterations=wanted)
            self._iterations = wanted

    def observe(self) -> Observation:
        """Read all sensors."""
        position, velocity, effort = self.arm.joint_states()
        n = len(self.robot.arm_joints)
        return Observation(
            joint_position=position,
            joint_velocity=velocity,
            joint_effort=effort,
            gripper_width=float(self.robot.gripper.width(position[n:])),
            base_from_tcp=self.arm.kinematics.forward(position[:n]),
            object_poses={body.name: self.pose(body.name) for body in self.scene.movable},
            contact_force=sum(
                contact[9]
                for link in self.arm.finger_links
                for contact in self.client.getContactPoints(bodyA=self.arm.body, linkIndexA=link)
            ),
            sensed={sensor.quantity: sensor.sense(self.client, self.arm) for sensor in SENSORS},
        )

    def body(self, name: str) -> Body:
        """Return the scene's body called `name`; KeyError if it does not exist."""
        return self._specs[name]

    def visuals(self) -> tuple[VisualBody, ...]:
        """Return the visible bodies in loading order, as at the reset.

        Raises:
            RenderError: A shape that no renderer draws.
        """
        if not self._visuals:
            names = {index: name for name, index in self._bodies.items()} | {self.arm.body: self.robot.name}
            textures = {self._bodies[body.name]: body.texture for body in self.scene.bodies if body.texture is not None}
            models = {
                self._bodies[body.name]: (body.shape.file, body.shape.scale)
                for body in self.scene.bodies
                if body.shape.kind == "urdf"
            } | {self.arm.body: (self.robot.urdf, self.scene.robot.scale)}
            self._visuals = visual_bodies(self.client, names=names, textures=textures, models=models)
        return self._visuals

    def mounts(self) -> dict[str, Mount]:
        """Return the robot's links by name, as mounts of cameras."""
        to_base = base_from_inertial(self.client, self.arm.body).inverse()
        return {
            name: Mount(body=self.arm.body, link=link, link_from_mount=to_base if link == -1 else None)
            for name, link in self.arm.links.items()
        }

    def poses(self) -> Array:
        """Read (n, 7) poses of all bodies and links, as `demorec.render.Renderer.render` takes them."""
        return body_poses(self.client)

    def pose(self, name: str) -> Pose:
        """Read `world_from_body` of a body of the scene.

        Bullet derives the quaternion from a matrix, so its sign would change as the body turns past 180 degrees. It
        keeps the sign of the last reading since the reset instead.
        """
        position, read = self.client.getBasePositionAndOrientation(self._bodies[name])
        quat = np.array(read)
        if name in self._quats and float(quat @ self._quats[name]) < 0:
            quat = -quat
        self._quats[name] = quat
        centre = Pose(position=np.array(position), quat_xyzw=quat)
        inertial = self.inertial_poses[name]
        if inertial == Pose():
            return centre
        return centre @ inertial.inverse()

    def velocity(self, name: str) -> tuple[Array, Array]:
        """Read linear (m/s) and angular (rad/s) velocity of a body of the scene, each (3,)."""
        linear, angular = self.client.getBaseVelocity(self._bodies[name])
        return np.array(linear), np.array(angular)

    def grip_force(self, name: str) -> float:
        """Compute the force (N) with which the hand grips a body of the scene; 0 unless every finger touches it."""
        read, body = self.client.getContactPoints, self._bodies[name]
        touching = [read(self.arm.body, body, link, -1) for link in self.arm.finger_links]
        return min(float(sum(contact[9] for contact in contacts)) for contacts in touching)

    def pressed_from_above(self, name: str, *, force: float = 3.0) -> bool:
        """Check whether the hand pushes down on a body with more than `force` N (contacts steeper than 45 degrees)."""
        contacts = self.client.getContactPoints(self.arm.body, self._bodies[name])
        return any(abs(contact[7][2]) > 0.7 and contact[9] > force for contact in contacts)

    def crushed(self) -> str:
        """Find a movable body on which a robot link presses harder than a real hand could; "" if none."""
        for body in self.scene.movable:
            index, forces = self._bodies[body.name], dict[int, float]()
            touching = self.client.getContactPoints(self.arm.body, index)
            for contact in touching:
                forces[contact[3]] = forces.get(contact[3], 0.0) + contact[9]
                if contact[8] < -MAX_PRESS_DEPTH or forces[contact[3]] > MAX_PRESS_FORCE:
                    return body.name
            # Contact points are where the bodies were before the last step; a blow may have turned one since.
            for point in self.client.getClosestPoints(self.arm.body, index, -MAX_PRESS_DEPTH) if touching else ():
                if -point[8] > MAX_PRESS_DEPTH + self._margin(self.arm.body, point[3]) + self._margin(index, point[4]):
                    return body.name
        return ""

    def _margin(self, body: int, link: int) -> float:
        """Compute how far Bullet's shape of a link (-1: the base) extends beyond the true one, metres."""
        shapes = self.client.getCollisionShapeData(body, link)
        return HULL_MARGIN if any(shape[2] == self.client.GEOM_MESH for shape in shapes) else 0.0

    def touches_robot(self, name: str) -> bool:
        """Check whether any part of the robot touches a body of the scene."""
        return bool(self.client.getContactPoints(self.arm.body, self._bodies[name]))

    def touches(self, name: str, other: str, *, gap: float = 5e-4) -> bool:
        """Check whether two bodies of the scene are closer than `gap` metres."""
        contacts = self.client.getContactPoints(self._bodies[name], self._bodies[other])
        return any(contact[8] < gap for contact in contacts)

    def state_digest(self) -> str:
        """Compute SHA-256 (hex) over positions and velocities of all joints and movable bodies, bit by bit."""
        sha = hashlib.sha256()
        position, velocity, _ = self.arm.joint_states()
        sha.update(position.tobytes())
        sha.update(velocity.tobytes())
        for body in self.scene.movable:
            index = self._bodies[body.name]
            place, quat = self.client.getBasePositionAndOrientation(index)
            linear, angular = self.client.getBaseVelocity(index)
            sha.update(np.array([*place, *quat, *linear, *angular]).tobytes())
        return sha.hexdigest()

    def set_state(self, *, joint_position: Array | None = None, object_poses: Mapping[str, Pose] | None = None) -> None:
        """Place joints and bodies without physics, at rest, to draw a recorded state.

        Args:
            joint_position: (n_joints,), fingers included; None keeps the robot's.
            object_poses: name -> world_from_body; bodies left out stay.
        """
        if joint_position is not None:
            self.arm.place_joints(np.asarray(joint_position, dtype=np.float64))
            self.arm.target = np.array(joint_position[: len(self.robot.arm_joints)], dtype=np.float64)
        for name, pose in (object_poses or {}).items():
            centre = pose if self.inertial_poses[name] == Pose() else pose @ self.inertial_poses[name]
            self.client.resetBasePositionAndOrientation(
                self._bodies[name], centre.position.tolist(), centre.quat_xyzw.tolist()
            )


def set_engine(client: Any, physics: Physics) -> None:
    """Set every engine parameter, including those at their default: some survive resetSimulation."""
    client.setGravity(*physics.gravity)
    client.setPhysicsEngineParameter(
        fixedTimeStep=1.0 / physics.hz,
        numSolverIterations=physics.solver_iterations,
        numSubSteps=0,
        deterministicOverlappingPairs=1,
        enableConeFriction=1,
        contactBreakingThreshold=physics.contact_breaking_threshold,
        collisionFilterMode=1,
        enableFileCaching=1,
        restitutionVelocityThreshold=0.2,
        erp=0.2,
        contactERP=0.08,
        frictionERP=0.2,
        solverResidualThreshold=1e-7,
        contactSlop=1e-5,
        enableSAT=0,
        constraintSolverType=client.CONSTRAINT_SOLVER_LCP_SI,
        globalCFM=0.0,
        minimumSolverIslandSize=1,
        warmStartingFactor=0.85,
        # Measure at the joint that has the sensor, along the axes of the link that it carries.
        jointFeedbackMode=client.JOINT_FEEDBACK_IN_JOINT_FRAME,
    )

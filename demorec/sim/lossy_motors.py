"""Joint motors that lose torque to damping and friction, as specified by a URDF's <dynamics>.

PyBullet applies damping with the velocity before the step, which makes a light joint unstable, and never applies
friction to a motor-driven joint. The equation of motion of a joint with inertia I is

    I dv/dt = motor torque - damping v - friction sign(v) + all other torques,

and the motor torque is limited. The solver's motor represents the first three terms: its limit is the remainder after
the losses, and the motor torque is the torque used by the solver plus the losses.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from demorec.core.geometry import Array

SLOW_SPEED = 1e-3
"""Maximum speed of a joint at rest, rad/s or m/s: friction grows with the speed there instead of jumping."""


class JointMotors(NamedTuple):
    """The motors of the joints of one body, each array (n,), in rad and N m, or m and N.

    Attributes:
        joints: PyBullet's indices.
        limit: Maximum torque or force.
        speed: Maximum speed; infinite if unlimited.
        gain: Ratio of the position error that a motor corrects in a physics step.
        damping: Torque or force lost per unit of speed.
        friction: Torque or force lost at any speed.
    """

    joints: tuple[int, ...]
    limit: Array
    speed: Array
    gain: Array
    damping: Array
    friction: Array

    def effort(self, used: Array, velocity: Array) -> Array:
        """Compute motor torques or forces (n,): those used by the solver, (n,), plus the losses at velocities (n,)."""
        loss = self.damping * velocity + self.friction * np.clip(velocity / SLOW_SPEED, -1.0, 1.0)
        return np.clip(used + loss, -self.limit, self.limit)

    def steady_speed(self) -> Array:
        """Speeds (n,) sustainable at the limits; infinite without damping, 0 if friction exceeds the limit."""
        left = self.limit - self.friction
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(left <= 0, 0.0, np.where(self.damping > 0, left / self.damping, np.inf))


def drive(client: Any, body: int, motors: JointMotors, targets: Array) -> None:
    """Set the motors to (n,) target positions for the next physics step."""
    states = client.getJointStates(body, motors.joints)
    position, velocity, used = (np.array([state[i] for state in states]) for i in (0, 1, 3))
    speed = np.minimum(motors.speed, motors.steady_speed())
    time_step = client.getPhysicsEngineParameters()["fixedTimeStep"]
    wanted = np.clip(motors.gain * (targets - position) / time_step, -speed, speed)
    # The motor's direction in this step is that of the last one; it changes where the limit does not matter.
    direction = np.sign(np.where(used == 0.0, wanted - velocity, used))
    is_moving = np.abs(velocity) > SLOW_SPEED
    friction = motors.friction * np.where(is_moving, np.sign(velocity) * direction, 1.0)
    left = np.maximum(motors.limit - direction * motors.damping * velocity - friction, 0.0)
    for index, joint in enumerate(motors.joints):
        client.setJointMotorControl2(
            body,
            joint,
            client.POSITION_CONTROL,
            targetPosition=float(targets[index]),
            force=float(left[index]),
            positionGain=float(motors.gain[index]),
            maxVelocity=float(np.clip(speed[index], _STANDSTILL, _NO_SPEED_LIMIT)),
        )


_STANDSTILL = 1e-12
"""rad/s or m/s: PyBullet interprets 0 as unlimited."""
_NO_SPEED_LIMIT = 1e30
"""Bullet's value for a motor without a speed limit."""

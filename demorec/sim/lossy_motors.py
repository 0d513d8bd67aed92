"""Motors of joints that lose torque to damping and friction, as the <dynamics> of a URDF says.

PyBullet applies damping with the velocity before the step, which makes a light joint explode, and never applies
friction to a joint that a motor drives. A joint's equation of motion with inertia I is

    I dv/dt = torque of the motor - damping v - friction sign(v) + everything else,

and the motor gives at most its limit. So the solver's motor, which stands for the first three terms, may use what the
limit leaves after the losses, and the motor's torque is what the solver used plus the losses.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from demorec.core.geometry import Array

SLOW_SPEED = 1e-3
"""Below this speed, rad/s or m/s, a joint rests: friction there grows with the speed, instead of jumping."""


class JointMotors(NamedTuple):
    """The motors of the joints of one body, each array (n,), in rad and N m, or m and N.

    Attributes:
        joints: PyBullet's indices.
        limit: Greatest torque or force.
        speed: Greatest speed; infinite for none.
        gain: Share of the position error that a motor corrects in a physics step.
        damping: Torque or force lost for each unit of speed.
        friction: Torque or force lost at any speed.
    """

    joints: tuple[int, ...]
    limit: Array
    speed: Array
    gain: Array
    damping: Array
    friction: Array

    def effort(self, used: Array, velocity: Array) -> Array:
        """Torques or forces (n,) of the motors: what the solver used, (n,), and what is lost at velocities (n,)."""
        loss = self.damping * velocity + self.friction * np.clip(velocity / SLOW_SPEED, -1.0, 1.0)
        return np.clip(used + loss, -self.limit, self.limit)

    def steady_speed(self) -> Array:
        """Speeds (n,) that the limits keep up against the losses; infinite without damping, 0 against much friction."""
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
    # The direction of the motor in this step is that of the last one; it changes where the limit does not matter.
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
"""rad/s or m/s: PyBullet takes 0 for no limit."""
_NO_SPEED_LIMIT = 1e30
"""What Bullet has for a motor without one."""

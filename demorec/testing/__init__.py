"""What every task and every robot must hold, as tests for pytest; somebody's own runs them in three lines:

from demorec.testing import RobotContract, TaskContract

class TestMyTask(TaskContract):
    task = "my_package.my_module:MyTask"

class TestMyArm(RobotContract):
    robot = "my_package.my_module:MY_ARM"
"""

from demorec.testing.robot_contract import RobotContract
from demorec.testing.task_contract import TaskContract

__all__ = ["RobotContract", "TaskContract"]

import numpy as np
import pytest

from ugr_lightning.sim.kinematics import UP, rotation_x, rotation_y
from ugr_lightning.sim.objects import pose_of


@pytest.fixture
def placed(handover):
    """Put the block somewhere over the pad and ask whether that is the goal."""
    handover.reset(0)
    environment = handover._env

    def condition(offset=(0.0, 0.0, 0.0), rotation=None, opening=1.0):
        environment.command[13] = opening
        environment.block._objs[0].set_pose(pose_of(environment.pad_point + 0.1 * UP + np.array(offset), rotation))
        return environment.condition()

    return condition


def test_the_lower_end_has_to_be_on_the_pad_within_the_thresholds(placed, holds_within):
    assert placed()
    assert holds_within(placed, (0.03, 0.03, 0.01))


def test_either_end_may_be_down_but_lying_does_not_count(placed):
    assert placed(rotation=rotation_x(np.pi))
    assert not placed((0.0, 0.0, -0.075), rotation=rotation_y(np.pi / 2))


def test_the_right_gripper_has_to_be_commanded_open(placed):
    assert placed(opening=0.81)
    assert not placed(opening=0.79)


def test_the_block_changes_hands_in_the_air(handover):
    frame = handover.reset(2)
    phases, heights, both = [], [], False
    for step in handover.expert():
        frame = handover.step(step.action)
        phases.append(step.phase)
        heights.append(handover._env.block_pose().position[2])
        both = both or bool(frame.contacts.all())
    assert both
    released = phases.index("release-left")
    assert min(heights[released : released + 20]) > 0.2
    assert frame.success

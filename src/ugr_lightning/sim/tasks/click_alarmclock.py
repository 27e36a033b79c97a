"""Press the button on top of an alarm clock with the closed gripper of the arm on its side of the table."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from ugr_lightning.sim.expert import Arms, ExpertStep, facing, gripper_down
from ugr_lightning.sim.kinematics import UP, TcpPose, rotation_z
from ugr_lightning.sim.objects import Prop, pose_of
from ugr_lightning.sim.scene import TwoArmEnv, side_of

# Success (FACTS 9): the gripper is commanded closed and touches the clock near the button point.
CLOSED = 0.2
TOUCH_RADIUS = 0.03

# Randomisation (FACTS 9).
X_RANGE = (0.05, 0.25)  # to the left or to the right of the middle
Y_RANGE = (-0.2, 0.0)

BUTTON_HEIGHT = 0.106  # top of the button above the table
BUTTON_RADIUS = 0.022
BODY = (0.10, 0.065, 0.078)  # flat on top, so that a touch within 3 cm of the button's middle is a touch of the clock
FEET = 0.014
FINGERTIP = 0.014  # fingertips beyond the TCP
HOVER = 0.07  # fingertips above the button before they go straight down
PRESS_DEPTH = 0.018  # commanded below the button's top, and below the body's: a policy's millimetres do not matter


class ClickAlarmclock(TwoArmEnv):
    """An alarm clock with a large button on top; either arm, straight down."""

    horizon = 200
    version = 2

    def build(self, rng: np.random.Generator) -> None:
        """Place the clock on either side, turned any way."""
        x = rng.uniform(*X_RANGE) * rng.choice([-1.0, 1.0])
        y, self.yaw = rng.uniform(*Y_RANGE), rng.uniform(-np.pi, np.pi)
        self.button_point = np.array([x, y, BUTTON_HEIGHT])
        pose = pose_of((x, y, 0.0), rotation_z(self.yaw))
        red, white, black, yellow = (0.80, 0.10, 0.12), (0.97, 0.97, 0.93), (0.04, 0.04, 0.05), (1.0, 0.85, 0.05)
        clock = Prop(self.scene)
        middle, front = FEET + BODY[2] / 2.0, -BODY[1] / 2.0
        clock.box(BODY, (0.0, 0.0, middle), red)
        clock.cylinder(0.034, 0.002, (0.0, front, middle), white, axis="y", solid=False)
        clock.box((0.005, 0.001, 0.024), (0.0, front - 0.0015, middle + 0.010), black, solid=False)
        clock.box((0.020, 0.001, 0.005), (0.009, front - 0.0015, middle), black, solid=False)
        for sign in (-1.0, 1.0):
            clock.box((0.018, 0.055, FEET), (0.035 * sign, 0.0, FEET / 2.0), black)
        clock.build("alarm_clock", pose, static=True)
        height = BUTTON_HEIGHT - FEET - BODY[2]
        Prop(self.scene).cylinder(BUTTON_RADIUS, height, (0.0, 0.0, BUTTON_HEIGHT - height / 2.0), yellow).build(
            "alarm_button", pose, static=True
        )

    def condition(self) -> bool:
        """The closed gripper on the clock's side touches it near the button point."""
        side = side_of(self.button_point[0])
        if self.opening(side) >= CLOSED:
            return False
        return any(
            touch.side == side
            and touch.other.startswith("alarm_")
            and bool((np.abs(touch.points - self.button_point) < TOUCH_RADIUS).all(axis=1).any())
            for touch in self.touches()
        )

    def expert(self, arms: Arms) -> Iterator[ExpertStep]:
        """Above the button while closing, straight down, and stay there."""
        side = side_of(self.button_point[0])
        rotation = gripper_down(facing(side))
        tip = self.button_point + FINGERTIP * UP
        above, pressed = TcpPose(tip + HOVER * UP, rotation), TcpPose(tip - PRESS_DEPTH * UP, rotation)
        yield from arms.move({side: above}, steps=54, phase="reach", grip={side: 0.0}, overlap=14)
        yield from arms.move({side: pressed}, steps=44, phase="press", slack=(1.0, 0.4, 0.0, 0.0))
        yield from arms.hold(8, phase="hold")

    def describe(self) -> dict[str, Any]:
        """Button point and the clock's yaw."""
        return {"button": self.button_point.tolist(), "yaw": float(self.yaw), "side": side_of(self.button_point[0])}

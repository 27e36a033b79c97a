"""A simulator without physics; its tasks, one file each in `tasks`, are the ways in which one can fail."""

import os
import signal
import threading
from pathlib import Path

import numpy as np

from ugr_lightning.embodiment import CAMERAS
from ugr_lightning.sim.expert import Arms, ExpertStep
from ugr_lightning.sim.frame import Frame
from ugr_lightning.sim.kinematics import TcpPose
from ugr_lightning.sim.outside_simulator import OutsideSimulator

HOME = np.tile(np.array([0, -0.9, 1.1, 0, -0.3, 0, 1], np.float32), 2)
GOAL = 0.4
STEPS = 12
MARKER = "UGR_TEST_MARKER"
"""Names the file that `deadly_once` leaves."""


class FakeSimulator(OutsideSimulator):
    """The first joint of the left arm has to come within 0.05 of a goal that a grey level of the pictures shows.

    Tasks: `reach`; `one_arm`: the same with 7 joints and one camera; `two_long_arms`: with 16 joints; `unsolvable`: no
    seed succeeds; `deadly`: seed 2 kills the process at step 3; `deadly_once`: only if the file named by MARKER is
    absent; `hang`: seed 2 never returns; `faulty`: seed 2 raises. In every task the expert gives up on the seeds 3, 8,
    13, ...; in `out_of_reach` because of a pose that it cannot reach.
    """

    cameras = CAMERAS
    control_hz = 25.0
    horizon = 20
    version = 1

    def __init__(self, task, *, setting="demo_clean", image_size=(120, 160), render=True, speed=1.0):
        super().__init__(task, image_size=image_size, render=render, speed=speed)
        self.setting = setting  # any, unlike those of an environment that others have made

    def camera_parameters(self):
        intrinsic = np.array([[30.0, 0, self.image_size[1] / 2], [0, 30.0, self.image_size[0] / 2], [0, 0, 1]])
        one = {"intrinsic_cv": intrinsic, "extrinsic_cv": np.eye(4)[:3], "cam2world_gl": np.eye(4)}
        return dict.fromkeys(self.cameras, one)

    def close(self):
        pass

    def _open(self):
        pass

    def _start(self, seed):
        self.seed, self.steps, self.done = seed, 0, False
        self.goal = GOAL + 0.02 * (seed % 7)
        self.commanded = self.measured = np.resize(HOME, self.action_dim)

    def _advance(self, action):
        self.steps += 1
        if self.seed == 2 and self.steps == 3:
            self._fail()
        self.commanded = np.clip(action, -3, 3)
        self.measured = (0.2 * self.measured + 0.8 * self.commanded).astype(np.float32)
        near = abs(float(self.measured[0]) - self.goal) < 0.05 and self.task != "unsolvable"
        self.done = self.done or near
        return near

    def _demonstrate(self):
        if self.seed % 5 == 3:
            far = TcpPose(np.array([9.0, 0.0, 0.0]), np.eye(3))
            if self.task == "out_of_reach":
                yield from Arms(self.commanded).move({"left": far}, steps=5, phase="reach")
            return
        for step in range(STEPS):
            action = np.resize(HOME, self.action_dim)
            action[0] = self.goal * min(1.0, (step + 1) / (STEPS - 3))
            yield ExpertStep(action, "reach" if step < 8 else "press", 1.0 if step < 8 else 0.0)

    def _describe(self):
        return {"goal": self.goal}

    def _fail(self):
        marker = Path(os.environ.get(MARKER, ""))
        if self.task == "deadly_once" and not marker.exists():
            marker.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        if self.task == "deadly":
            os.kill(os.getpid(), signal.SIGKILL)
        if self.task == "hang":
            threading.Event().wait()
        if self.task == "faulty":
            raise ValueError("the scene fell over")

    def _picture(self, camera):
        height, width = self.image_size
        view = self.cameras.index(camera)
        picture = np.zeros((height, width, 3), np.uint8)
        picture[..., view] = 40 * view + self.steps
        picture[: height // 2] = round(300 * (self.goal - GOAL)) + 40
        return picture

    def _frame(self, images, success):
        endpose = np.tile([0.0, 0, 0, 1, 0, 0, 0], (2, 1))
        contacts = np.array([self.done, False])
        return Frame(images, self.commanded.copy(), self.measured.copy(), endpose, contacts, success)

"""Put the mug down in the middle with the left arm, and hang it by its handle on the rack with the right arm."""

import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np
from mani_skill.utils.structs import Actor

from ugr_lightning.sim.expert import Arms, ExpertStep, facing, gripper_down
from ugr_lightning.sim.kinematics import HOME, UP, Array, TcpPose, rotation_y, rotation_z
from ugr_lightning.sim.objects import Colour, Prop, pose_of
from ugr_lightning.sim.scene import TwoArmEnv

# Success and randomisation follow RoboTwin-Platform/RoboTwin@13c3c47, envs/hanging_mug.py.

# Success: the middle of the handle's opening against the middle of the peg, right gripper open. RoboTwin also
# wants the mug 12 cm above the table; here the peg, 27 cm high, has to pass through the handle. That is stricter:
# success is latched, and a mug that is let go beside the peg falls through RoboTwin's region.
TOLERANCE = 0.02  # in x and in y
OPEN = 0.8

# Randomisation. RoboTwin has the rack at x 0.1 .. 0.3, where the peg would meet the hand of the resting right arm, and
# the mug turned by up to +-1.57, where it hides its handle from the high camera.
MUG_X, MUG_Y = (-0.25, -0.1), (-0.05, 0.05)
MUG_YAW = (-0.8, 0.8)  # of the handle, from pointing at the left arm
RACK_X, RACK_Y, RACK_YAW = (0.0, 0.1), (0.15, 0.19), (-0.2, 0.2)
MUG_RADIUS, MUG_HEIGHT = (0.024, 0.027), (0.078, 0.09)
HANDLE_REACH = (0.036, 0.042)  # from the wall to the outside of the handle
MUG_COLOURS: dict[str, Colour] = {
    "blue": (0.10, 0.28, 0.75),
    "red": (0.80, 0.10, 0.10),
    "green": (0.05, 0.50, 0.28),
    "purple": (0.45, 0.15, 0.60),
}

WALL, FLOOR, TUBE = 0.0044, 0.006, 0.0045  # thickness of the mug, radius of its handle
SIDES_OF_MUG = 12  # flat walls; two of them face the fingers
PEG_RADIUS, PEG_LENGTH, PEG_TILT, PEG_HEIGHT = 0.004, 0.14, 0.25, 0.27

MEETING_POINT = np.array([0.0, -0.12, 0.0])
PUT_DOWN = np.array([0.02, 0.02, 0.2])  # m, m, rad: up to this far from there, as a policy does, and not always on it
GRASP = 0.6  # fraction of the mug's height
BEYOND = 0.06  # how far in front of the peg the handle waits
REST = 0.002  # commanded below the height at which the handle touches the peg


class HangingMug(TwoArmEnv):
    """Left grasps across the handle and sets the mug down; right takes it, tips it over and slides it onto the peg."""

    horizon = 530
    version = 3  # demonstrations of 2 tilted every third mug before the right hand had it; the scenes are those of 1

    def build(self, rng: np.random.Generator) -> None:
        """Place the mug on the left, its handle away from the middle, and the rack on the right."""
        x, y, turn = (rng.uniform(*limits) for limits in (MUG_X, MUG_Y, MUG_YAW))
        rack_x, rack_y, rack_yaw = (rng.uniform(*limits) for limits in (RACK_X, RACK_Y, RACK_YAW))
        self.radius, self.height, self.reach = (
            rng.uniform(*limits) for limits in (MUG_RADIUS, MUG_HEIGHT, HANDLE_REACH)
        )
        self.colour = list(MUG_COLOURS)[rng.integers(len(MUG_COLOURS))]
        self.mug_start, self.rack = (x, y, np.pi + turn), (rack_x, rack_y, rack_yaw)
        # Level with the centre of mass: the mug then hangs level.
        self.opening_middle = np.array([self.radius + self.reach / 2.0 - TUBE, 0.0, 0.44 * self.height])
        # Half-axes of the half ellipse that the handle follows, outwards from the wall and along the mug.
        self.handle_axes = (self.reach - TUBE, self.opening_middle[2] - TUBE - 0.005)
        self.mug: Actor = self._mug(MUG_COLOURS[self.colour]).build(
            "mug", pose_of((x, y, 0.0005), rotation_z(np.pi + turn))
        )
        turned = rotation_z(rack_yaw)
        self.peg_direction = turned @ np.array([0.0, -np.cos(PEG_TILT), np.sin(PEG_TILT)])
        self.peg_root = np.array([rack_x, rack_y, PEG_HEIGHT])
        x, y, turn = PUT_DOWN * rng.uniform(-1.0, 1.0, 3)  # drawn last: scenes do not depend on it
        self.put_down = TcpPose(MEETING_POINT + np.array([x, y, 0.0]), rotation_z(np.pi + turn))
        self._rack().build("rack", pose_of((rack_x, rack_y, 0.0), turned), static=True)

    def _mug(self, colour: Colour) -> Prop:
        """A cup with its handle along x."""
        r, h, mug = self.radius, self.height, Prop(self.scene)
        inner, lip = r - WALL, 0.0012
        outline = [(0.0, 0.0), (r - 0.004, 0.0), (r - 0.001, 0.002), (r, 0.006), (r, h - lip), (r - lip, h)]
        mug.lathe(outline, colour)
        mug.lathe([(r - lip, h), (inner, h - lip), (inner, FLOOR), (0.0, FLOOR)], (0.93, 0.91, 0.86))
        mug.cylinder(r, FLOOR, (0.0, 0.0, FLOOR / 2.0), None)
        width = 2.0 * r * np.tan(np.pi / SIDES_OF_MUG)
        for k in range(SIDES_OF_MUG):
            turned = rotation_z(2.0 * np.pi * k / SIDES_OF_MUG)
            x, y, _ = turned @ np.array([r - WALL / 2.0, 0.0, 0.0])
            mug.box((WALL, width, h - FLOOR), (x, y, (h + FLOOR) / 2.0), None, rotation=turned)
        out, along = self.handle_axes
        arc = np.linspace(-np.pi / 2.0, np.pi / 2.0, 11)
        x, z = r + out * np.cos(arc), self.opening_middle[2] + along * np.sin(arc)
        points = np.stack([x, np.zeros_like(x), z], axis=1)  # (11, 3)
        for start, end in itertools.pairwise(points):
            mug.capsule(start, end, TUBE, colour)
        return mug

    def _rack(self) -> Prop:
        """A post on a foot, with one long peg towards the camera."""
        wood, light, rack = (0.36, 0.20, 0.10), (0.85, 0.68, 0.40), Prop(self.scene)
        rack.cylinder(0.065, 0.016, (0.0, 0.0, 0.008), wood)
        rack.cylinder(0.010, PEG_HEIGHT + 0.02, (0.0, 0.0, PEG_HEIGHT / 2.0 + 0.018), wood)
        rack.capsule((0.0, 0.0, PEG_HEIGHT + 0.03), (0.0, 0.0, PEG_HEIGHT + 0.034), 0.014, wood)
        tip = PEG_LENGTH * np.array([0.0, -np.cos(PEG_TILT), np.sin(PEG_TILT)]) + PEG_HEIGHT * UP
        rack.capsule((0.0, 0.0, PEG_HEIGHT), tip, PEG_RADIUS, light)
        return rack

    def mug_pose(self) -> TcpPose:
        """Measured origin (middle of the bottom) and orientation of the mug."""
        matrix = self.mug._objs[0].pose.to_transformation_matrix().astype(np.float64)
        return TcpPose(matrix[:3, 3], matrix[:3, :3])

    def on_peg(self) -> bool:
        """Whether the peg passes through the opening of the handle."""
        origin, rotation = self.mug_pose()
        root, tip = (
            rotation.T @ (self.peg_root + length * self.peg_direction - origin) for length in (0.0, PEG_LENGTH)
        )
        if root[1] * tip[1] >= 0.0:
            return False
        crossing = root + (tip - root) * root[1] / (root[1] - tip[1])  # (3,) where the peg meets the handle's plane
        out = (crossing[0] - self.radius) / self.handle_axes[0]
        along = (crossing[2] - self.opening_middle[2]) / self.handle_axes[1]
        return bool(out > 0.0 and np.hypot(out, along) < 1.0)

    def condition(self) -> bool:
        """The mug hangs on the middle of the peg and the right gripper is open."""
        origin, rotation = self.mug_pose()
        offset = origin + rotation @ self.opening_middle - self.peg_root - PEG_LENGTH / 2.0 * self.peg_direction
        placed = bool((np.abs(offset[:2]) < TOLERANCE).all())
        return placed and self.on_peg() and self.opening("right") > OPEN

    def expert(self, arms: Arms) -> Iterator[ExpertStep]:
        """Grasp, set down in the middle, change hands, tip over, slide on, let go."""
        yield from self._set_down(arms)
        yield from self._take(arms)
        yield from self._hang(arms)

    def _set_down(self, arms: Arms) -> Iterator[ExpertStep]:
        grasp = self._grasp("left")
        yield from arms.move({"left": _raised(grasp, 0.11)}, steps=34, phase="reach", overlap=10)
        yield from arms.move({"left": grasp}, steps=24, phase="descend-left", slack=(1.0, 0.3, 0.0, 0.0))
        yield from arms.grip({"left": 0.0}, steps=10, phase="grasp-left")
        yield from arms.move(
            {"left": _raised(grasp, 0.08)}, steps=18, phase="lift-left", slack=(0.0, 0.0, 1.0), overlap=8
        )
        waiting = TcpPose(np.array([0.2, -0.1, 0.25]), gripper_down(facing("right")))
        place, turned = self.put_down
        above = self._carrying("left", place + 0.06 * UP, turned)
        yield from arms.move(
            {"left": above, "right": waiting}, steps=38, phase="carry-left", slack=(1.0, 1.0, 0.4), overlap=8
        )
        down = self._carrying("left", place + 0.001 * UP, turned)
        yield from arms.move({"left": down}, steps=24, phase="lower", slack=(0.4, 0.2, 0.0))
        yield from arms.grip({"left": 1.0}, steps=10, phase="release-left")

    def _take(self, arms: Arms) -> Iterator[ExpertStep]:
        up = _raised(arms.pose("left"), 0.13)
        yield from arms.move({"left": up}, steps=18, phase="retreat-left", slack=(0.0, 0.0, 0.1, 0.8), overlap=6)
        grasp = self._grasp("right")
        goals: dict[str, TcpPose | Array] = {"left": HOME, "right": _raised(grasp, 0.11)}
        yield from arms.move(goals, steps=36, phase="exchange", slack=(1.0,), overlap=10)
        # As much noise while the fingers close as a policy errs, a few millimetres; three times that tips the mug over.
        yield from arms.move({"right": grasp}, steps=26, phase="descend-right", slack=(1.0, 0.6, 0.15, 0.1))
        yield from arms.grip({"right": 0.0}, steps=10, phase="grasp-right", slack=0.1)
        lifted = _raised(grasp, 0.12)
        yield from arms.move({"right": lifted}, steps=22, phase="lift-right", slack=(0.1, 0.0, 1.0), overlap=8)

    def _hang(self, arms: Arms) -> Iterator[ExpertStep]:
        before = self._hanging(PEG_LENGTH + BEYOND)
        yield from arms.move({"right": before}, steps=46, phase="tip", slack=(1.0, 1.0, 0.8, 0.4), overlap=6)
        yield from arms.move(
            {"right": self._hanging(PEG_LENGTH / 2.0)}, steps=36, phase="insert", slack=(0.4, 0.2, 0.1)
        )
        drop = self.reach / 2.0 - TUBE - PEG_RADIUS + REST
        yield from arms.move({"right": self._hanging(PEG_LENGTH / 2.0, drop)}, steps=12, phase="rest", slack=(0.1, 0.0))
        yield from arms.grip({"right": 1.0}, steps=10, phase="release-right")
        last = arms.pose("right")
        back = TcpPose(last.position - 0.1 * last.rotation[:, 0], last.rotation)
        yield from arms.move({"right": back}, steps=16, phase="retreat-right", slack=(0.0, 0.3, 1.0))

    def _grasp(self, side: str) -> TcpPose:
        """Straight down over the mug as it stands, fingers left and right of the handle, which points to the arm."""
        origin, rotation = self.mug_pose()
        backwards = np.arctan2(rotation[1, 0], rotation[0, 0]) + (np.pi if side == "left" else 0.0)
        yaw = facing(side) + (backwards - facing(side) + np.pi) % (2.0 * np.pi) - np.pi
        return TcpPose(origin + GRASP * self.height * UP, gripper_down(yaw))

    def _hanging(self, along: float, below: float = 0.0) -> TcpPose:
        """Right tool pose that holds the mug on its side: `along` metres from the peg's root, `below` its line."""
        rotation = (
            rotation_z(self.rack[2]) @ rotation_y(np.pi / 2.0) @ rotation_z(np.pi)
        )  # handle up, bottom to the left
        middle = self.peg_root + along * self.peg_direction - below * UP
        return self._carrying("right", middle - rotation @ self.opening_middle, rotation)

    def _carrying(self, side: str, origin: Array, rotation: Array) -> TcpPose:
        """Tool pose that brings the mug to a pose, as it sits in the hand now."""
        tool = self.tool_pose(side).to_transformation_matrix().astype(np.float64)
        held = self.mug_pose()
        turn = rotation @ held.rotation.T  # (3, 3) from the mug's orientation now
        return TcpPose(origin + turn @ (tool[:3, 3] - held.position), turn @ tool[:3, :3])

    def describe(self) -> dict[str, Any]:
        """Where mug and rack were at the start, and the mug's shape and colour."""
        return {
            "mug": [float(value) for value in self.mug_start],
            "rack": [float(value) for value in self.rack],
            "mug_shape": {"radius": float(self.radius), "height": float(self.height), "handle": float(self.reach)},
            "colour": self.colour,
        }


def _raised(pose: TcpPose, height: float) -> TcpPose:
    return TcpPose(pose.position + height * UP, pose.rotation)

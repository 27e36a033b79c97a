"""Motion primitives of the scripted experts: smooth tool paths as joint commands, one control step at a time."""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ugr_lightning.sim.kinematics import (
    SIDES,
    Array,
    TcpPose,
    UnreachableError,
    forward,
    inverse,
    rotation_from_vector,
    rotation_vector,
    rotation_y,
    rotation_z,
    to_base,
    to_world,
)

MAX_JOINT_STEP = 0.35  # rad per control step; more means that the path has changed its branch
_BRANCH_TOLERANCE = 0.3  # rad between where a straight line ends and the posture that is good to continue from
_ROLL_WEIGHT = 1.5
_ONSET = 10  # control steps over which slack rises at the start of an episode


class ExpertStep(NamedTuple):
    """What the expert wants at one control step.

    Args:
        action: (14,) float32 absolute command.
        phase: what the expert is doing, e.g. `reach`, `press`, `grasp-left`.
        slack: 0 .. 1, how much execution noise this moment tolerates (1 in free space, 0 at contact).
    """

    action: np.ndarray
    phase: str
    slack: float


def minimum_jerk(fraction: float) -> float:
    """Fraction of a point-to-point movement done after a fraction of its time, at rest at both ends."""
    u = min(max(fraction, 0.0), 1.0)
    return u**3 * (10.0 - 15.0 * u + 6.0 * u * u)


def gripper_down(yaw: float) -> Array:
    """World orientation of a gripper that points straight down, turned by `yaw` rad about the vertical; (3, 3)."""
    return rotation_z(yaw) @ rotation_y(np.pi / 2.0)


def gripper_level(yaw: float) -> Array:
    """World orientation of a gripper that points along the horizontal direction `yaw`; (3, 3)."""
    return rotation_z(yaw)


def facing(side: str) -> float:
    """The yaw (rad) at which an arm looks across the table, away from its base."""
    return 0.0 if side == "left" else np.pi


def grasp_yaw(side: str, object_yaw: float) -> float:
    """Gripper yaw that lines up with a square object, closest to the arm's natural yaw."""
    natural, quarter = facing(side), np.pi / 2.0
    return natural + (object_yaw - natural + quarter / 2.0) % quarter - quarter / 2.0


class Arms:
    """The nominal command of both arms, and the motions that continue from it.

    It knows nothing of what the robot really did: motions continue from the last nominal command, so that noise added
    to what is executed is corrected by the very next command. Where objects are, the task reads from the simulator.

    Args:
        command: (14,) command in force.
        speed: divides the duration of every motion.
        base_height: of the arms' bases above the table top, metres.
    """

    def __init__(self, command: np.ndarray, speed: float = 1.0, base_height: float = 0.0) -> None:
        self.speed, self.base_height = speed, base_height
        self.joints: dict[str, Array] = {
            s: np.array(command[i : i + 6], float) for s, i in zip(SIDES, (0, 7), strict=True)
        }
        self.opening = {"left": float(command[6]), "right": float(command[13])}
        self._coming: dict[str, list[Array]] = {"left": [], "right": []}  # joints still to be commanded
        self._emitted = 0

    def pose(self, side: str) -> TcpPose:
        """World tool pose at which the motions commanded so far end."""
        return to_world(side, forward(self._end(side)), self.base_height)

    def move(
        self,
        goals: Mapping[str, TcpPose | Array],
        *,
        steps: int,
        phase: str,
        slack: Sequence[float] = (1.0,),
        grip: Mapping[str, float] | None = None,
        overlap: int = 0,
    ) -> Iterator[ExpertStep]:
        """Move one or both arms together along straight lines, with the velocity of minimum jerk.

        An arm that has no motion left holds its pose. A straight line that the arm cannot follow (it would leave the
        joint limits, jump to another branch or end in a twisted posture) is replaced by a straight line in joint space.

        Args:
            goals: per side a world tool pose, or (6,) joints.
            steps: control steps at speed 1.
            phase: label of the steps.
            slack: values at equally spaced moments of the motion, smooth in between.
            grip: per side the opening (0 .. 1) to ramp to over the motion.
            overlap: how many steps before its end the next motion takes over and is added to the rest of this one, so
                that the arm does not stop in between.

        Raises:
            UnreachableError: a goal is out of reach.
        """
        count = self._scaled(steps)
        for side, goal in goals.items():
            self._coming[side] = self._plan(side, goal, count, phase)
        openings = {side: (self.opening[side], value) for side, value in (grip or {}).items()}
        emitted = max(1, count - (self._scaled(overlap) if overlap else 0))
        for k in range(1, emitted + 1):
            for side, (start, end) in openings.items():
                self.opening[side] = start + (end - start) * minimum_jerk(k / emitted)
            yield self._emit(phase, _between(slack, k / emitted))

    def grip(
        self, openings: Mapping[str, float], *, steps: int, phase: str, slack: float = 0.0
    ) -> Iterator[ExpertStep]:
        """Open or close grippers while the arms hold their pose, and give the fingers a moment to arrive."""
        ramp = max(1, round(0.7 * steps))
        yield from self.move({}, steps=ramp, phase=phase, slack=(slack,), grip=openings)
        yield from self.hold(steps - ramp, phase=phase, slack=slack)

    def hold(self, steps: int, *, phase: str, slack: float = 0.0) -> Iterator[ExpertStep]:
        """Keep the last command."""
        yield from self.move({}, steps=steps, phase=phase, slack=(slack,))

    def _scaled(self, steps: int) -> int:
        return max(1, round(steps / self.speed))

    def _end(self, side: str) -> Array:
        return self._coming[side][-1] if self._coming[side] else self.joints[side]

    def _emit(self, phase: str, slack: float) -> ExpertStep:
        for side in SIDES:
            if self._coming[side]:
                self.joints[side] = self._coming[side].pop(0)
        action = np.concatenate([np.append(self.joints[side], self.opening[side]) for side in SIDES])  # (14,)
        self._emitted += 1
        onset = minimum_jerk((self._emitted - 1) / _ONSET)
        return ExpertStep(action.astype(np.float32), phase, float(slack * onset))

    def _plan(self, side: str, goal: TcpPose | Array, count: int, phase: str) -> list[Array]:
        """Joint commands of a motion, added to what is left of the one before."""
        end = self._end(side)
        before = self._coming[side][:count]
        before = before + [end] * (count - len(before))
        if isinstance(goal, TcpPose):
            target = to_base(side, goal, self.base_height)
            try:
                posture = inverse(target, end, prefer_small_rolls=_ROLL_WEIGHT)
            except UnreachableError as error:
                expected, got = "a tool pose within its reach", f"position {np.round(goal.position, 3).tolist()}"
                fix = "Choose a nearer one, or turn the tool: joints have limits."
                raise UnreachableError(f"{side} arm, phase `{phase}`", expected, got, fix) from error
            straight = _straight_line(before, target, self.joints[side])
            if straight is not None and np.abs(straight[-1] - posture).max() < _BRANCH_TOLERANCE:
                return straight
        else:
            posture = np.asarray(goal, float)
        return [joints + (posture - end) * minimum_jerk((k + 1) / count) for k, joints in enumerate(before)]


def _between(knots: Sequence[float], fraction: float) -> float:
    """Value at a fraction (0 .. 1) of a smooth curve through equally spaced knots."""
    place = fraction * (len(knots) - 1)
    index = min(int(place), max(len(knots) - 2, 0))
    following = knots[min(index + 1, len(knots) - 1)]
    return knots[index] + (following - knots[index]) * minimum_jerk(place - index)


def _straight_line(before: list[Array], target: TcpPose, start: Array) -> list[Array] | None:
    """Joints along a straight tool path to `target` that is added to the path `before`; None if the arm cannot."""
    ending = forward(before[-1])
    shift, turn = target.position - ending.position, rotation_vector(ending.rotation.T @ target.rotation)
    path, last = [], start
    for k, joints in enumerate(before):
        done, base = minimum_jerk((k + 1) / len(before)), forward(joints)
        try:
            pose = TcpPose(base.position + shift * done, base.rotation @ rotation_from_vector(turn * done))
            found = inverse(pose, last)
        except UnreachableError:
            return None
        if np.abs(found - last).max() > MAX_JOINT_STEP:
            return None
        path.append(found)
        last = found
    return path

"""How the cameras and joints of a file become those of the policy, where names, order or units differ."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ugr_lightning.embodiment import CAMERAS, STATE_DIM
from ugr_lightning.errors import ConfigError, DataError

Vector = Literal["state", "action"]

OTHER_NAMES = {
    "cam_high": ("head_camera", "cam_head"),
    "cam_right_wrist": ("right_camera",),
    "cam_left_wrist": ("left_camera",),
}
"""What RoboTwin and XPolicyLab call our cameras."""


@dataclass(frozen=True)
class Joint:
    """One number of the policy's vector, taken from one column of the file's.

    Args:
        source: column in the file, by position from 0 or by the name the file gives it.
        scale: the policy's value is `scale` times the file's, plus `offset`.
        offset: see `scale`, in the policy's units.
        closed: of a gripper, the file's value that means closed; the policy sees 0 there.
        open: of a gripper, the file's value that means open; the policy sees 1 there.
    """

    source: int | str
    scale: float = 1.0
    offset: float = 0.0
    closed: float | None = None
    open: float | None = None

    def __post_init__(self) -> None:
        where = f"data.layout, joint {self.source!r}"
        if isinstance(self.source, int) and self.source < 0:
            raise ConfigError(where, "a position from 0 or a name", self.source, "Correct the number.")
        gripper = (self.closed, self.open)
        if gripper != (None, None) and (None in gripper or self.closed == self.open):
            raise ConfigError(where, "different values for `closed` and `open`", gripper, "Give both.")
        if gripper != (None, None) and (self.scale, self.offset) != (1.0, 0.0):
            got = "all of them"
            raise ConfigError(where, "`scale` and `offset`, or `closed` and `open`", got, "Leave out two.")
        if self.scale == 0:
            raise ConfigError(where, "a scale other than 0", self.scale, "Correct the number.")

    def convert(self, values: np.ndarray) -> np.ndarray:
        """The file's values in the policy's units, float32; unchanged to the bit where nothing was asked for."""
        if self.closed is not None and self.open is not None:
            return ((values.astype(np.float64) - self.closed) / (self.open - self.closed)).astype(np.float32)
        if (self.scale, self.offset) == (1.0, 0.0):
            return values
        return (values.astype(np.float64) * self.scale + self.offset).astype(np.float32)


@dataclass(frozen=True)
class Layout:
    """Which cameras and joints of a file a policy sees, by name; the default takes the file as it is.

    Args:
        cameras: the policy's name of a camera: the file's; those left out have the names the format is known for.
        state: how many columns the file's joint vector has, all taken as they are; or the joints to take, in order,
            each a position, a name, or a `Joint` with units.
        action: the same for commands; null for the same as `state`.
    """

    cameras: dict[str, str] = field(default_factory=dict)
    state: int | tuple[Joint | int | str, ...] = STATE_DIM
    action: int | tuple[Joint | int | str, ...] | None = None

    def __post_init__(self) -> None:
        for name in ("state", "action"):
            if self.dim(name) < 1:
                raise ConfigError(f"data.layout.{name}", "at least one joint", 0, "Correct the number.")

    @classmethod
    def of_training(cls, data: Mapping[str, Any]) -> "Layout":
        """The layout that a policy was trained with.

        Args:
            data: what its checkpoint says of its data; without a layout the default one.

        Raises:
            ConfigError: something else, such as a layout of a later version.
        """

        def joints(given: Any) -> Any:
            if given is None or isinstance(given, int):
                return given
            return tuple(Joint(**joint) if isinstance(joint, Mapping) else joint for joint in given)

        content = data.get("layout")
        if content is None:
            return cls()
        try:
            return cls(dict(content["cameras"]), joints(content["state"]), joints(content["action"]))
        except (KeyError, TypeError, ValueError) as error:
            got, fix = f"{type(error).__name__}: {error}", "Update ugr-lightning, or use another checkpoint."
            raise ConfigError("the layout in the checkpoint", "cameras and joints", got, fix) from error

    @property
    def state_dim(self) -> int:
        """S, length of the policy's state."""
        return self.dim("state")

    @property
    def action_dim(self) -> int:
        """A, length of the policy's action."""
        return self.dim("action")

    @property
    def picked(self) -> list[Vector]:
        """Which of the policy's vectors are other than the file's columns as they are, from the first on."""
        given: dict[Vector, Any] = {"state": self.state, "action": self.action}
        return [v for v, joints in given.items() if isinstance(joints, tuple) and joints != tuple(range(len(joints)))]

    def names(self, columns: Sequence[str], vector: Vector) -> tuple[str, ...]:
        """What the policy's numbers are called: as in the file, or as they are picked from it.

        Args:
            columns: names of the file's columns; empty where it does not say.
            vector: of which of the two.
        """
        wanted = self._wanted(vector)
        if isinstance(wanted, int):
            return tuple(columns) if len(columns) == wanted else tuple(map(str, range(wanted)))
        sources = [joint.source if isinstance(joint, Joint) else joint for joint in wanted]
        return tuple(columns[s] if isinstance(s, int) and s < len(columns) else str(s) for s in sources)

    def dim(self, vector: Vector) -> int:
        """Length of one of the policy's vectors."""
        wanted = self._wanted(vector)
        return wanted if isinstance(wanted, int) else len(wanted)

    def width(self, vector: Vector) -> int | None:
        """How many columns the file has to have; None where it may be any number, because joints are picked."""
        wanted = self._wanted(vector)
        return wanted if isinstance(wanted, int) else None

    def take(self, values: np.ndarray, vector: Vector, names: Sequence[str], where: object) -> np.ndarray:
        """Turn rows of a file into rows of the policy's vector.

        Args:
            values: (T, D) float32, as the file has them.
            vector: which of the two.
            names: what the file calls its D columns; empty where it does not say.
            where: file and key, for the error.

        Returns:
            (T, S) or (T, A) float32, C-contiguous.

        Raises:
            DataError: another number of columns than stated, or a joint that the file does not have.
            ConfigError: units in which a joint is no finite number.
        """
        wanted, columns = self._wanted(vector), values.shape[1]
        if isinstance(wanted, int):
            if columns != wanted:
                fix = (
                    f"Say so with `--data.layout.{vector} {columns}` and `--model.policy.init_args.{vector}_dim "
                    f"{columns}`, or pick columns by position or name; `ugr data inspect` lists them."
                )
                raise DataError(where, f"shape (T, {wanted})", values.shape, fix)
            return np.ascontiguousarray(values)
        joints = [joint if isinstance(joint, Joint) else Joint(joint) for joint in wanted]
        known = dict(zip(names, range(columns), strict=False))
        missing = [j.source for j in joints if j.source not in known and j.source not in range(columns)]
        if missing:
            got = f"{columns} columns{': ' if known else ' without names'}{', '.join(known)}"
            raise DataError(where, f"the joints {missing} of `data.layout.{vector}`", got, "Correct the layout.")
        places = [joint.source if isinstance(joint.source, int) else known[joint.source] for joint in joints]
        with np.errstate(over="ignore", invalid="ignore"):  # looked at below
            taken = [joint.convert(values[:, place]) for joint, place in zip(joints, places, strict=True)]
        rows = np.stack(taken, axis=1)  # (T, S) or (T, A)
        if not np.isfinite(rows).all():
            odd = joints[int(np.argwhere(~np.isfinite(rows))[0, 1])]
            fix = "Correct its `scale`, `offset`, `closed` or `open`."
            raise ConfigError(
                f"data.layout.{vector}, joint {odd.source!r}", "finite numbers", f"others in {where}", fix
            )
        return rows

    def find_cameras(self, cameras: Sequence[str], available: Sequence[str], where: Path) -> tuple[str, ...]:
        """What the cameras asked for are called in a file.

        Args:
            cameras: the policy's names, in order.
            available: the file's names.
            where: the file, for the error.

        Raises:
            ConfigError: no camera asked for, or one that neither the layout nor the file knows.
        """
        known = known_cameras(available) | self.cameras
        unknown = [camera for camera in cameras if camera not in known]
        if unknown or not cameras:
            fix = "Correct the name, or say in `data.layout.cameras` what the file calls it."
            expected = f"names among {', '.join(known) or 'those of the file, which has none'}"
            raise ConfigError(f"data.cameras for {where}", expected, ", ".join(unknown) or "none", fix)
        return tuple(known[camera] for camera in cameras)

    def _wanted(self, vector: Vector) -> int | tuple[Joint | int | str, ...]:
        return self.state if vector == "state" or self.action is None else self.action


def known_cameras(available: Sequence[str]) -> dict[str, str]:
    """The policy's names for the cameras of a file: ours where another project's name is known, else the file's own.

    Args:
        available: the file's names.
    """
    known = {camera: camera for camera in available}
    for camera in CAMERAS:
        theirs = next((name for name in OTHER_NAMES[camera] if name in known), None)
        if camera not in known and theirs is not None:
            known[camera] = known.pop(theirs)
    return known


def policy_cameras(available: Sequence[str]) -> tuple[str, ...]:
    """The cameras of a file by the policy's names, ours in our order first."""
    found = known_cameras(available)
    return (*(camera for camera in CAMERAS if camera in found), *(c for c in found if c not in CAMERAS))


DEFAULT_LAYOUT = Layout()

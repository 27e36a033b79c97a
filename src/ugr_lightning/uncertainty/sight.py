"""How well a policy that looks for keyframes sees each of them: which step of a task is missed for want of sight."""

from typing import NamedTuple

import numpy as np

from ugr_lightning.results.tables import Cells
from ugr_lightning.sim.kinematics import SIDES
from ugr_lightning.uncertainty.predictions import Predictions


class SeenKeyframe(NamedTuple):
    """How far from one keyframe of an arm a policy sees it, from at most a chunk before it.

    Args:
        arm: left or right.
        keyframe: its number in the demonstrations, from 1.
        step: when it is there, median.
        new, known: (median, ninth decile) of the distances on validation and on training scenes, mm; NaN of none.
    """

    arm: str
    keyframe: int
    step: int
    new: tuple[float, float]
    known: tuple[float, float]


def sight_of_keyframes(validation: Predictions, training: Predictions) -> list[SeenKeyframe]:
    """How well each keyframe of a task is seen; empty for a policy that does not look for them.

    Args:
        validation, training: predictions on both parts of the split.
    """
    if validation.keyframe is None or training.keyframe is None:
        return []
    found = []
    for arm, side in enumerate(SIDES):
        (new, of_new), (known, of_known) = _numbered(validation, arm), _numbered(training, arm)
        for number in range(1 + max(of_new.max(), of_known.max())):
            here, there = of_new == number, of_known == number  # (n,), (m,)
            when = np.concatenate([validation.keyframe[here, arm], training.keyframe[there, arm]])
            found.append(
                SeenKeyframe(side, number + 1, int(np.median(when)), _spread(new[here]), _spread(known[there]))
            )
    return found


def _numbered(part: Predictions, arm: int) -> tuple[np.ndarray, np.ndarray]:
    """How far off an arm's next keyframe is seen, mm, NaN if it is beyond the chunk, and its number: (n,) each."""
    assert part.missed is not None
    assert part.keyframe is not None
    when, number = part.keyframe[:, arm], np.zeros(len(part.step), int)  # (n,) each
    for episode in np.unique(part.episode):
        own = part.episode == episode
        number[own] = np.unique(when[own], return_inverse=True)[1]
    within = when - part.step <= part.coarse.shape[1]
    return np.where(within, 1000 * part.missed[:, arm], np.nan), number


def _spread(distances: np.ndarray) -> tuple[float, float]:
    seen = distances[~np.isnan(distances)]
    return (float(np.median(seen)), float(np.quantile(seen, 0.9))) if len(seen) else (np.nan, np.nan)


def sight_table(found: list[SeenKeyframe]) -> Cells:
    """`sight_of_keyframes` as cells, heading first."""
    head = ("arm", "keyframe", "at step", "off on new scenes, median / ninth decile", "on training scenes")
    return [head, *((s.arm, str(s.keyframe), str(s.step), _words(s.new), _words(s.known)) for s in found)]


def _words(spread: tuple[float, float]) -> str:
    return "never near" if np.isnan(spread[0]) else f"{spread[0]:.1f} / {spread[1]:.1f} mm"

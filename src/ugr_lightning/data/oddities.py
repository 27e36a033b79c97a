"""What is unusual about demonstrations: each function looks for one thing and says it in one line, or nothing."""

import itertools
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from ugr_lightning.data.inspection import Inspection, SeenEpisode, fits_swapped
from ugr_lightning.data.selection import shorten, told_strays
from ugr_lightning.embodiment import GRIPPERS, STATE_DIM

STILL = 1e-4  # a joint that moves less than this in all episodes is constant, in its own units
JUMP_OF_RANGE, JUMP_OF_USUAL, USUAL = 0.3, 8.0, 0.9  # of a joint's range; times what so many of its steps stay below


def find_oddities(found: Inspection, chunk_length: int) -> list[str]:
    """Everything unusual, one line each.

    Args:
        found: from `inspect_demonstrations`.
        chunk_length: K of the policy that is to be trained.
    """
    looks: tuple[Iterable[str], ...] = (
        _numbering(found),
        _unfinished(found.folder),
        told_strays(found.form.strays(found.folder)),
        _duplicates(found.seen),
        _short(found.seen, chunk_length),
        _without_colour(found),
        _sizes(found.seen),
        _constant(found),
        _grippers(found),
        _jumps(found),
        _repeats(found.seen),
        _colours(found.seen),
    )
    return [line for lines in looks for line in lines]


def gripper_columns(names: Sequence[str]) -> list[int]:
    """The columns that are grippers, by name, or by place where 14 columns have no names."""
    if len(names) == STATE_DIM and all(name.isdecimal() for name in names):
        return list(GRIPPERS)
    return [column for column, name in enumerate(names) if re.search("gripper|_ee$", name.lower())]


def _numbering(found: Inspection) -> Iterable[str]:
    present = list(found.present)
    gaps = [(one + 1, other - 1) for one, other in itertools.pairwise(present) if other - one > 1]
    if gaps:
        words = [str(first) if first == last else f"{first} to {last}" for first, last in gaps]
        yield f"numbers without an episode: {shorten(words)}"


def _unfinished(folder: Path) -> Iterable[str]:
    partial = sorted(path.name for path in folder.rglob("*.partial")) if folder.is_dir() else []
    if partial:
        yield f"unfinished files, left by something that was interrupted: {shorten(partial)}"


def _duplicates(seen: Sequence[SeenEpisode]) -> Iterable[str]:
    counts = Counter(one.episode.seed for one in seen if one.episode.seed is not None)
    again = [seed for seed, count in counts.items() if count > 1]
    if again:
        yield f"seeds used more than once: {shorten(again)}"
    first: dict[bytes, int] = {}
    same = []
    for one in seen:
        key = one.episode.state.tobytes() + one.episode.action.tobytes()
        if key in first:
            same.append(f"{one.index} is {first[key]}")
        first.setdefault(key, one.index)
    if same:
        yield f"episodes with the same states and actions: {shorten(same)}"


def _short(seen: Sequence[SeenEpisode], chunk_length: int) -> Iterable[str]:
    short = [one.index for one in seen if one.episode.length < chunk_length]
    if short:
        yield f"{len(short)} episodes shorter than a chunk of {chunk_length} steps: {shorten(short)}"


def _without_colour(found: Inspection) -> Iterable[str]:
    others = [f"{camera} ({what})" for camera, what in found.contents.others.items()]
    if others:
        yield f"cameras without colour pictures, left out: {shorten(others)}"


def _sizes(seen: Sequence[SeenEpisode]) -> Iterable[str]:
    for camera in seen[0].views:
        sizes = {one.views[camera].size for one in seen}
        if len(sizes) > 1:
            yield f"{camera} has different sizes: {shorten([f'{h}x{w}' for h, w in sorted(sizes)])}"
    if len({view.size for one in seen for view in one.views.values()}) > 1:
        yield "pictures differ in size: give them one with `data.image_size` to train on them"


def _constant(found: Inspection) -> Iterable[str]:
    for vector in ("state", "action"):
        rows = np.concatenate(found.rows(vector))  # (N, D)
        still = [name for name, span in zip(found.names(vector), np.ptp(rows, axis=0), strict=True) if span < STILL]
        if still:
            yield f"{vector} never moves in {shorten(still, 16)}"


def _grippers(found: Inspection) -> Iterable[str]:
    for vector in ("state", "action"):
        rows, names = np.concatenate(found.rows(vector)), found.names(vector)
        for column in gripper_columns(names):
            low, high = float(rows[:, column].min()), float(rows[:, column].max())
            if low < 0 or high > 1:
                share = float(np.mean((rows[:, column] < 0) | (rows[:, column] > 1)))
                yield (
                    f"{vector} {_called(names[column])} is outside 0 (closed) to 1 (open) in {share:.0%} of the steps: "
                    f"{low:.3g} to {high:.3g}; say what open and closed are in `data.layout`"
                )


def _called(name: str) -> str:
    return f"column {name}" if name.isdecimal() else name


def _jumps(found: Inspection) -> Iterable[str]:
    """Steps in which an arm joint moves by much of its range, and much more than it usually does."""
    for vector in ("state", "action"):
        names, rows = found.names(vector), found.rows(vector)
        steps = [np.abs(np.diff(values, axis=0)) for values in rows]  # (T - 1, D) each
        every = np.concatenate(steps)
        if not len(every):
            continue
        usual, span = np.quantile(every, USUAL, axis=0), np.ptp(np.concatenate(rows), axis=0)
        limit = np.maximum(np.maximum(JUMP_OF_RANGE * span, JUMP_OF_USUAL * usual), STILL)  # (D,)
        limit[gripper_columns(names)] = np.inf  # commanded to open and close at once
        where = [
            f"episode {one.index} step {step + 1} {_called(names[column])} by {moved[step, column]:.3g}"
            for one, moved in zip(found.seen, steps, strict=True)
            for step, column in np.argwhere(moved > limit)
        ]
        if where:
            yield f"{vector} jumps: {shorten(where, 4)}"


def _repeats(seen: Sequence[SeenEpisode]) -> Iterable[str]:
    """Pictures that are the one before, apart from those of moments in which nothing was commanded either."""
    for camera in seen[0].views:
        total, moving, where = 0, 0, []
        for one in seen:
            repeated = list(one.views[camera].repeated)
            moved = np.abs(np.diff(one.episode.state, axis=0)).max(axis=1) > STILL  # (T - 1,)
            of_moving = sum(bool(moved[step - 1]) for step in repeated)
            total, moving = total + len(repeated), moving + of_moving
            if of_moving:
                where.append(one.index)
        if total:
            steps = sum(one.episode.length for one in seen)
            in_motion = f", {moving} of them while joints move (episodes {shorten(where)})" if moving else ""
            yield f"{camera} repeats its picture in {total} of {steps} steps{in_motion}"


def _colours(seen: Sequence[SeenEpisode]) -> Iterable[str]:
    """Pictures that fit their neighbours only with red and blue swapped, and what the mark in them says."""
    for camera in seen[0].views:
        inside = [f"episode {one.index} step {step}" for one in seen for step in one.views[camera].swapped]
        if inside:
            yield f"{camera} swaps red and blue from one step to the next, against its marks: {shorten(inside, 4)}"
        reference = seen[0].views[camera].first
        others = [one.index for one in seen[1:] if fits_swapped(one.views[camera].first, reference)]
        if others:
            yield (
                f"{camera} shows red and blue swapped, compared with episode {seen[0].index}, in the episodes "
                f"{shorten(others)}: the mark in them, or its absence, is wrong"
            )
        marks = {(one.views[camera].marked or 0) / one.episode.length for one in seen}
        if (len(marks) > 1 or 0 < min(marks) < 1) and not others and not inside:
            yield f"{camera} has JPEGs with and without the mark of true RGB; each is read by its own"

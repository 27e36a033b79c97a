"""What demonstrations are, measured from their numbers and pictures: for people who got them from somewhere else."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ugr_lightning.data.episode import Episode
from ugr_lightning.data.formats import Contents, EpisodeFormat, EpisodeLocation, detect
from ugr_lightning.data.keyframes import keyframe_labels, missing_for_keyframes
from ugr_lightning.data.layout import Layout, Vector
from ugr_lightning.data.pins import draw_pins
from ugr_lightning.data.selection import ALL, Selection
from ugr_lightning.data.storage.hdf5_frames import JpegFrames
from ugr_lightning.data.storage.jpeg import stores_rgb
from ugr_lightning.errors import ConfigError, DataError, UGRError

SAMPLED_SIDE = 40  # pixels a side, about, by which pictures are compared for swapped colours
APART = 8.0  # mean difference, of 255, up to which two pictures show the same scene in the same colours
CLEARER = 3.0  # times that a picture has to fit better with red and blue swapped
LAGS = 11  # steps ahead in which the state that an action equals is looked for
SAME = 1e-6  # difference up to which two joints are the same, beyond the rounding of float32


class SeenCamera(NamedTuple):
    """What one camera shows in one episode.

    Args:
        size: (height, width).
        repeated: steps whose picture is the one before, to the bit.
        swapped: steps whose picture fits the one before much better with red and blue swapped.
        marked: how many pictures are JPEGs with the mark of true RGB; None where they are no JPEGs.
        first: (h, w, 3) uint8, some pixels of the first picture.
        shown: pictures of the steps asked for, (H, W, 3) uint8 each, with pins at the hands' next keyframes where the
            demonstration has them, see `draw_pins`.
        lacks: what keyframes of this camera would need and the demonstration does not have.
    """

    size: tuple[int, int]
    repeated: tuple[int, ...]
    swapped: tuple[int, ...]
    marked: int | None
    first: np.ndarray
    shown: tuple[np.ndarray, ...]
    lacks: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class SeenEpisode:
    """One readable episode.

    Args:
        index: its number in the folder.
        episode: its numbers; with the first camera only.
        views: by camera.
        steps: those that are shown.
    """

    index: int
    episode: Episode
    views: dict[str, SeenCamera]
    steps: tuple[int, ...]


@dataclass
class Inspection:
    """What was found in a folder of demonstrations.

    Args:
        folder: folder or file.
        form: its format.
        contents: cameras and columns of the first readable episode.
        state, action: what the columns are called after `data.layout`.
        present: all episodes of the folder, by index.
        seen: the episodes that were read, in order.
        unreadable: by index, what is wrong with the others.
    """

    folder: Path
    form: EpisodeFormat
    contents: Contents
    state: tuple[str, ...]
    action: tuple[str, ...]
    present: dict[int, EpisodeLocation]
    seen: list[SeenEpisode] = field(default_factory=list)
    unreadable: dict[int, UGRError] = field(default_factory=dict)

    def names(self, vector: Vector) -> tuple[str, ...]:
        """What the columns of one of the vectors are called."""
        return self.state if vector == "state" else self.action

    def rows(self, vector: Vector) -> list[np.ndarray]:
        """One of the vectors of every readable episode, (T, S) or (T, A) float32 each."""
        return [getattr(one.episode, vector) for one in self.seen]


def inspect_demonstrations(
    folder: Path,
    *,
    cameras: Sequence[str] | None = None,
    layout: Layout | None = None,
    selection: Selection = ALL,
    sampled: int | None = None,
    pictured: int = 8,
    done: Callable[[int, int], None] = lambda index, total: None,
) -> Inspection:
    """Read every number and every picture of demonstrations of any format, or of some of them.

    Args:
        folder: folder or file.
        cameras: names that a policy would use; null for all there are.
        layout: joints and cameras as a policy would see them; null for all columns as they are.
        selection: which demonstrations of the folder.
        sampled: look at so many of them at most, spread evenly; null for all.
        pictured: of how many episodes pictures are kept, of three steps each; of one, so many steps.
        done: called with the number of episodes looked at, and how many there are to look at.

    Raises:
        DataError: no format recognises it, or not one episode can be read; then says what is wrong with the first.
        ConfigError: a camera that the files do not have.
    """
    folder = Path(folder)
    form = detect(folder)
    present = form.find(folder)
    if not present:
        raise DataError(folder, f"demonstrations of {form.name}", "none", "Check the path.")
    chosen = list(selection.choose(present, folder).items())
    if sampled is not None and sampled < len(chosen):
        chosen = [chosen[place] for place in np.linspace(0, len(chosen) - 1, sampled).round().astype(int)]
    contents, failed = _peek(form, chosen)
    layout = layout or contents.layout
    names = (layout.names(contents.state, "state"), layout.names(contents.action, "action"))
    found = Inspection(folder, form, contents, *names, present)
    kept = set(np.linspace(0, len(chosen) - 1, min(pictured, len(chosen))).astype(int).tolist())
    for number, (index, location) in enumerate(chosen, start=1):
        shown = 0 if number - 1 not in kept else 3 if len(chosen) > 1 else pictured
        try:
            found.seen.append(_look(form, index, location, cameras or contents.cameras, layout, shown))
        except (DataError, ConfigError) as error:
            found.unreadable[index] = failed.get(index, error)
        done(number, len(chosen))
    if not found.seen:
        raise next(iter(found.unreadable.values()))
    return found


def _peek(form: EpisodeFormat, chosen: Sequence[tuple[int, EpisodeLocation]]) -> tuple[Contents, dict[int, DataError]]:
    """The contents of the first episode that can be read, and the errors of those before it."""
    failed: dict[int, DataError] = {}
    for index, location in chosen:
        try:
            contents = form.peek(location)
        except DataError as error:
            failed[index] = error
            continue
        if contents.cameras:
            return contents, failed
        got = ", ".join(f"{camera} ({what})" for camera, what in contents.others.items()) or "none"
        failed[index] = DataError(location.path, "a camera with colour pictures", got, "Record with pictures.")
    raise next(iter(failed.values()))


def _look(
    form: EpisodeFormat, index: int, location: EpisodeLocation, cameras: Sequence[str], layout: Layout, shown: int
) -> SeenEpisode:
    """Read one episode, each camera by itself: they may differ in size."""
    views, first, steps = {}, None, ()
    for camera in cameras:
        episode = form.read(location, (camera,), layout)
        first = first or episode
        steps = tuple(np.linspace(0, episode.length - 1, min(shown, episode.length)).astype(int).tolist())
        try:
            views[camera] = _view(episode, steps)
        finally:
            episode.frames.close()
    assert first is not None
    return SeenEpisode(index, first, views, steps)


def _view(episode: Episode, steps: Sequence[int]) -> SeenCamera:
    repeated, swapped, shown = [], [], []
    height, width = episode.image_size
    stride = max(1, max(height, width) // SAMPLED_SIDE)
    marked = 0 if isinstance(episode.frames, JpegFrames) else None
    before = first = small = np.empty(0)
    for step in range(episode.length):
        picture = episode.images(step)[0]  # (H, W, 3)
        if marked is not None and stores_rgb((episode.frames.jpegs(step) or (b"",))[0]):
            marked += 1
        earlier, small = small, picture[::stride, ::stride].copy()
        if step == 0:
            first = small
        elif np.array_equal(picture, before):
            repeated.append(step)
        elif fits_swapped(small, earlier):
            swapped.append(step)
        before = picture
        if step in steps:
            shown.append(_with_keyframes(picture, episode, step))
    lacks = tuple(missing_for_keyframes(episode))
    return SeenCamera((height, width), tuple(repeated), tuple(swapped), marked, first, tuple(shown), lacks)


def _with_keyframes(picture: np.ndarray, episode: Episode, step: int) -> np.ndarray:
    """A picture of an episode of one camera with a pin at each hand's next keyframe, where these are known."""
    labels = keyframe_labels(episode)
    if labels is None or episode.projection is None:
        return picture
    tools = labels[0][step]  # (2, 3)
    points = np.stack([tools, tools], axis=1)  # (2, 2, 3)
    points[:, 1, 2] = episode.extras.get("table_height", 0.0)
    return draw_pins(picture, points, episode.projection[step, 0], mark_absent=True)


def fits_swapped(picture: np.ndarray, other: np.ndarray) -> bool:
    """Whether a picture is much more like another of the same scene with red and blue swapped than as it is.

    Args:
        picture, other: (H, W, 3) uint8.
    """
    if picture.shape != other.shape:
        return False
    reference = other.astype(np.int16)
    as_it_is = float(np.abs(picture - reference).mean())
    swapped = float(np.abs(picture[..., ::-1] - reference).mean())
    return as_it_is > APART > swapped and swapped * CLEARER < as_it_is


class Alignment(NamedTuple):
    """What the action of a step is in terms of states, over the steps in which a joint moves.

    Args:
        moving: how many steps that are.
        is_state, is_next_state: in how many of them the action equals the state of the same, of the next step.
        distances: mean absolute difference to the state of the same step, the next, ...; empty if nothing moves.
    """

    moving: int
    is_state: int
    is_next_state: int
    distances: tuple[float, ...]


def measure_alignment(states: Sequence[np.ndarray], actions: Sequence[np.ndarray]) -> Alignment | None:
    """Compare actions with the states of the same and of later steps.

    Args:
        states, actions: (T, S) and (T, A) of each episode.

    Returns:
        None where states and actions have different columns.
    """
    if any(state.shape != action.shape for state, action in zip(states, actions, strict=True)):
        return None
    counts, sums, numbers = np.zeros(3, int), np.zeros(LAGS), np.zeros(LAGS, int)
    for state, action in zip(states, actions, strict=True):
        if len(state) < 2:
            continue
        moves = _differs(state[1:], state[:-1])  # (T - 1,)
        same, following = ~_differs(action[:-1], state[:-1]), ~_differs(action[:-1], state[1:])
        counts += [moves.sum(), (same & moves).sum(), (following & moves).sum()]
        for lag in range(LAGS):
            rows = np.flatnonzero(moves[: max(0, len(state) - max(lag, 1))])
            sums[lag] += float(np.abs(action[rows].astype(np.float64) - state[rows + lag]).sum())
            numbers[lag] += len(rows) * state.shape[1]
    means = tuple(float(total / number) for total, number in zip(sums, numbers, strict=True) if number)
    moving, is_state, is_next_state = map(int, counts)
    return Alignment(moving, is_state, is_next_state, means)


def _differs(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Rows in which two arrays differ, (T,) bool."""
    return (np.abs(one - other) > SAME + SAME * np.abs(other)).any(axis=1)

"""Writing demonstrations again in another format: whole episodes only, and a second run goes on with the first."""

import fcntl
import hashlib
import json
import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ugr_lightning.data.episode import Episode
from ugr_lightning.data.formats import EpisodeFormat, detect, find_format, formats
from ugr_lightning.data.layout import Layout
from ugr_lightning.data.selection import ALL, Selection, told_strays
from ugr_lightning.errors import ConfigError, DataError
from ugr_lightning.system.files import publish_text
from ugr_lightning.system.lock import flock

NOTE = "conversion.json"  # in the target: what it is a conversion of

Done = Callable[[str, int, int], None]


def convert(
    source: Path,
    target: Path,
    to: str,
    *,
    cameras: Sequence[str] | None = None,
    layout: Layout | None = None,
    selection: Selection = ALL,
    rate: float | None = None,
    done: Done = lambda what, number, total: None,
) -> list[Episode]:
    """Convert demonstrations; everything is read and checked before anything is written.

    Stopped at any point, the target has whole episodes only, and the same call goes on with the first one missing.

    Args:
        source: a folder or file of any format that is recognised.
        target: a folder that is empty, not there yet, or holds what an earlier call with the same arguments wrote.
        to: name of the format to write.
        cameras: cameras by the policy's names; null for all there are.
        layout: joints and cameras as a policy would see them; null for all columns as they are.
        selection: which demonstrations of the source.
        rate: steps per second; null for what the files say.
        done: called with `reading`, `writing` or `checking`, the number of episodes that are, and their total.

    Returns:
        The source's episodes, in the order in which they are numbered in the target.

    Raises:
        DataError: a damaged episode, one that the format cannot hold, a target with something else in it, a disk that
            is full, or numbers that did not come back as they were.
        ConfigError: an unknown format or camera, one that is only read, a package that is missing, or a target that is
            the source.
    """
    source, target = Path(source), Path(target)
    form = find_format(to)
    if not form.writable:
        written = ", ".join(one.name for one in formats() if one.writable)
        raise ConfigError("--to", f"a format that can be written: {written}", to, "Choose another.")
    _check_target(source, target)
    found = _read_all(source, cameras, layout, selection, rate, done)
    form.check(found)
    note = _describe(found, source, to)
    try:
        with _alone(target):
            _check_note(target, note)
            publish_text(target / NOTE, json.dumps(note, indent=2) + "\n")
            form.write(target, found, lambda index: done("writing", index + 1, len(found)))
            _check_written(form, target, found, done)
    except OSError as error:
        fix = "Make room, or choose another folder; the same command goes on."
        raise DataError(target, "a folder that can be written", str(error), fix) from error
    return found


@contextmanager
def _alone(target: Path) -> Iterator[None]:
    """Only one process at a time converts into a folder; the lock goes with its holder, however that ends."""
    target.mkdir(parents=True, exist_ok=True)
    folder = os.open(target, os.O_RDONLY)
    try:
        try:
            flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            expected, got = "a folder that nobody else writes", "another conversion at work in it"
            raise DataError(target, expected, got, "Wait until it ends.") from error
        yield
    finally:
        os.close(folder)


def _check_target(source: Path, target: Path) -> None:
    """What can be said before the source is read."""
    if target.exists() and not target.is_dir():
        raise ConfigError("the target", "a folder", f"the file {target}", "Choose another name.")
    if target.resolve() == source.resolve():
        raise ConfigError("the target", "another folder than the source", target, "Choose another name.")
    if target.is_dir() and not (target / NOTE).is_file():
        others = sorted(path.name for path in target.iterdir() if not path.name.startswith(f"{NOTE}."))
        if others:
            got = ", ".join(others[:6]) + " ..." * (len(others) > 6)
            raise DataError(
                target, f"an empty folder, or one with the {NOTE} of this conversion", got, "Choose another."
            )


def _read_all(
    source: Path,
    cameras: Sequence[str] | None,
    layout: Layout | None,
    selection: Selection,
    rate: float | None,
    done: Done,
) -> list[Episode]:
    form = detect(source)
    locations = list(selection.choose(form.find(source), source).values())
    if not locations:
        raise DataError(source, f"demonstrations of {form.name}", "none", "Check the path.")
    for told in told_strays(form.strays(source)):
        warnings.warn(f"{source}: {told}", stacklevel=3)
    contents = form.peek(locations[0])
    found = []
    for number, location in enumerate(locations, start=1):
        episode = form.read(location, cameras or contents.cameras, layout or contents.layout)
        if rate is not None:
            episode = replace(episode, extras=episode.extras | {"control_hz": float(rate)})
        found.append(episode)
        done("reading", number, len(locations))
    return found


def _describe(episodes: Sequence[Episode], source: Path, to: str) -> dict[str, Any]:
    """What tells one conversion from another; the place of the source does not."""
    digest = hashlib.sha256()
    for episode in episodes:
        for values in (episode.state, episode.action):
            digest.update(f"{values.shape}".encode() + values.tobytes())
        sizes = [path.stat().st_size for path in episode.frames.files]
        digest.update(f"{episode.name} {_sizes(episode)} {episode.extras.get('control_hz')} {sizes}".encode())
    return {
        "from": source.name,
        "to": to,
        "cameras": list(episodes[0].cameras),
        "episodes": [episode.name for episode in episodes],
        "sha256": digest.hexdigest(),
    }


def _sizes(episode: Episode) -> object:
    """The size of the pictures, or all sizes where cameras differ."""
    sizes = episode.frames.image_sizes
    return sizes[0] if len(set(sizes)) == 1 else sizes


def _check_note(target: Path, note: dict[str, Any]) -> None:
    """A conversion that was begun may only be gone on with by itself."""
    path = target / NOTE
    if not path.is_file():
        return
    try:
        begun = json.loads(path.read_text())
        differ = [name for name in note if name != "from" and begun.get(name) != note[name]]
    except (OSError, ValueError, AttributeError, RecursionError) as error:
        raise DataError(path, "the note of a conversion", str(error), "Choose an empty folder.") from error
    if differ:
        got = f"one with other {' and '.join(differ)}"
        raise DataError(path, "the conversion that was begun here", got, "Choose an empty folder.")


def _check_written(form: EpisodeFormat, target: Path, episodes: Sequence[Episode], done: Done) -> None:
    """Read everything back: state and action have to be the same to the bit, measured joints the same or none."""
    if list(form.find(target)) != list(range(len(episodes))):
        raise DataError(target, f"episodes 0 to {len(episodes) - 1}", list(form.find(target))[:8], "Convert again.")
    for number, (back, given) in enumerate(_read_back(form, target, episodes), start=1):
        same = np.array_equal(back.state, given.state) and np.array_equal(back.action, given.action)
        same = same and (back.measured is None or _same(back.measured, given.measured))
        if not same or back.frames.image_sizes != given.frames.image_sizes:
            got = "other numbers, or pictures of another size"
            raise DataError(back.path, f"what {given.path} has", got, "Remove this file and convert again.")
        done("checking", number, len(episodes))


def _read_back(form: EpisodeFormat, target: Path, episodes: Sequence[Episode]) -> Iterator[tuple[Episode, Episode]]:
    """What was written, each beside what was given."""
    for location, given in zip(form.find(target).values(), episodes, strict=True):
        layout = Layout(state=given.state.shape[1], action=given.action.shape[1])
        yield form.read(location, given.cameras, layout), given


def left_out(
    form: EpisodeFormat, target: Path, episodes: Sequence[Episode], done: Done = lambda what, number, total: None
) -> list[str]:
    """What the source says of any episode and the target does not give back as it was, by name.

    Args:
        form: the format written.
        target: the folder written.
        episodes: as `convert` returns them.
        done: as for `convert`.
    """
    fields = ("seed", "measured", "endpose", "projection")
    lost: set[str] = set()
    for number, both in enumerate(_read_back(form, target, episodes), start=1):
        kept, known = ({**{name: getattr(of, name) for name in fields}, **of.extras} for of in both)
        lost |= {name for name, value in known.items() if value is not None and not _same(value, kept.get(name))}
        done("comparing", number, len(episodes))
    return sorted(lost)


def _same(one: Any, other: Any) -> bool:
    """Whether two values are equal, arrays in every number."""
    return np.array_equal(one, other)

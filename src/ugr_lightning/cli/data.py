"""`ugr data inspect` and `ugr data convert`: demonstrations of any format that is recognised."""

from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ugr_lightning.cli.parsing.call import Count, call_one_of
from ugr_lightning.data.layout import Layout
from ugr_lightning.embodiment import CHUNK_LENGTH
from ugr_lightning.errors import ConfigError, DataError

if TYPE_CHECKING:
    from ugr_lightning.data.inspection import Inspection

SAMPLED = 50  # demonstrations that are looked at where there are more
HEAD_BYTES = 2**13  # of a contact sheet, with what it says of itself


def inspect_data(
    path: str,
    cameras: list[str] | None = None,
    layout: Layout | None = None,
    tasks: str | list[str] | None = None,
    episodes: int | list[int] | None = None,
    all: bool = False,
    chunk_length: Count = CHUNK_LENGTH,
    picture: str | None = None,
) -> int:
    """Say what demonstrations are: format, lengths, cameras, rates, what the actions are, statistics, oddities.

    Of more than 50 demonstrations 50 are looked at, spread evenly; of those every number and every picture is read.
    Exit code 2 where an episode cannot be read.

    Args:
        path: a folder or a file of any format that is recognised.
        cameras: cameras by the names that a policy would use; null for all there are.
        layout: joints and cameras as a policy would see them; null for everything as it is.
        tasks: only episodes of these tasks, by name or by pattern (`click_*`), where the data name them.
        episodes: only the first so many, or those with these numbers; null for all.
        all: look at every demonstration, however many there are.
        chunk_length: K of the policy that is to be trained; shorter episodes are listed.
        picture: where the contact sheet goes, in place of an earlier one of the same at most; null
            means `TASK-SETTING.png`, after the last two folders, in the working folder.
    """
    from ugr_lightning.data.inspection import inspect_demonstrations
    from ugr_lightning.data.selection import Selection
    from ugr_lightning.system.progress import Progress

    place = Path(path)
    sheet = Path(picture or _sheet_name(place))
    _check_sheet(sheet, place)
    with ExitStack() as stack:
        bars: list[Progress] = []

        def done(number: int, total: int) -> None:
            if not bars:
                bars.append(stack.enter_context(Progress(f"reading {place.name}", total, shown=total > 1)))
            bars[0].advance()

        found = inspect_demonstrations(
            place,
            cameras=cameras,
            layout=layout,
            selection=Selection(tasks or (), episodes),
            sampled=None if all else SAMPLED,
            done=done,
        )
    print("\n".join([*_describe(found, chunk_length), f"pictures    {_contact_sheet(found, sheet)}"]), flush=True)
    return 2 if found.unreadable else 0


def _describe(found: "Inspection", chunk_length: int) -> list[str]:
    from ugr_lightning.data.oddities import find_oddities
    from ugr_lightning.data.selection import count_tasks, describe_tasks, shorten

    seen, first = found.seen, found.seen[0]
    lengths = [one.episode.length for one in seen]
    seeds = [one.episode.seed for one in seen if one.episode.seed is not None]
    said = sorted({str(v) for one in seen for k in ("task", "instruction") if (v := one.episode.extras.get(k))})
    many = f"{min(lengths)} to {max(lengths)} decision steps, mean {np.mean(lengths):.0f}, {sum(lengths)} in all"
    complete = "all readable" if not found.unreadable else f"{len(found.unreadable)} of them UNREADABLE"
    count = len(seen) + len(found.unreadable)
    of_all = f" of {len(found.present)}" if count < len(found.present) else ""
    further = found.contents.further
    tasks = describe_tasks(count_tasks(found.present.values()))
    cameras = [f"{camera} {view.size[0]}x{view.size[1]}" for camera, view in first.views.items()]
    lines = [
        f"{found.folder}: {found.form.name}, {count}{of_all} demonstrations, {complete}",
        f"episodes    {shorten([one.index for one in seen])}",
        f"steps       {many if len(seen) > 1 else f'{lengths[0]} decision steps'}",
        f"rate        {_rate(found)}",
        f"cameras     {', '.join(cameras)} (height x width), {_colour_order(found)}",
        f"measured    {'no' if first.episode.measured is None else 'joints as they were, `data.state: measured`'}",
        f"seeds       {shorten(seeds) if seeds else 'none recorded'}",
        *([f"task        {tasks or shorten(said, 3)}"] if tasks or said else []),
        f"action      {_alignment(found)}",
        f"keyframes   {_keyframes(found)}",
        *([f"further     {shorten(further, 16)}: columns that `data.layout.state` can pick"] if further else []),
        *_statistics(found),
    ]
    unreadable = [f"UNREADABLE  {index}: {error}" for index, error in found.unreadable.items()]
    oddities = find_oddities(found, chunk_length) or ["none found"]
    return [*lines, *(f"{'oddities' if i == 0 else '':<12}{line}" for i, line in enumerate(oddities)), *unreadable]


def _rate(found: "Inspection") -> str:
    extras = [one.episode.extras for one in found.seen]
    rates = sorted({extra["control_hz"] for extra in extras if extra.get("control_hz") is not None})
    frequencies = sorted({extra["frequency"] for extra in extras if extra.get("frequency") is not None})
    words = [", ".join(f"{rate:g}" for rate in rates) + " steps per second"] if rates else ["not stated"]
    if frequencies:
        words.append(f"`frequency` {', '.join(map(str, frequencies))}: simulation steps between frames, if RoboTwin's")
    return "; ".join(words)


def _colour_order(found: "Inspection") -> str:
    views = [view for one in found.seen for view in one.views.values()]
    if views[0].marked is None:
        return "stored as true RGB"
    marked = sum(view.marked or 0 for view in views)
    total = sum(one.episode.length * len(one.views) for one in found.seen)
    if marked == 0:
        return "JPEGs with red and blue swapped on disk, as RoboTwin's are"
    return f"JPEGs, {marked} of {total} marked as true RGB, the others swapped on disk"


def _alignment(found: "Inspection") -> str:
    """What the action of a step is, in words."""
    from ugr_lightning.data.inspection import measure_alignment

    measured = measure_alignment(found.rows("state"), found.rows("action"))
    stored = found.seen[0].episode.extras.get("action_alignment")
    note = f" (the file's rows: {stored})" if stored else ""
    if measured is None:
        return f"has other columns than the state: they cannot be compared{note}"
    if not measured.moving or not measured.distances:
        return f"cannot be told from the numbers: no joint moves{note}"
    n = measured.moving
    for count, words in ((measured.is_next_state, "state[t+1]"), (measured.is_state, "state[t]")):
        if count == n:
            return f"action[t] is {words}, in all {n} steps in which a joint moves{note}"
    best = int(np.argmin(measured.distances))
    near = ", ".join(f"{d:.4f} to state[t{f'+{k}' if k else ''}]" for k, d in enumerate(measured.distances[:3]))
    return (
        f"action[t] is a command of its own: state[t+1] in {measured.is_next_state} and state[t] in "
        f"{measured.is_state} of {n} steps in which a joint moves; nearest to state[t{f'+{best}' if best else ''}], "
        f"mean distance {near}{note}"
    )


def _keyframes(found: "Inspection") -> str:
    """Whether a policy can be told where each hand will grip next."""
    lacks = {camera: view.lacks for one in found.seen for camera, view in one.views.items() if view.lacks}
    if not lacks:
        height = found.seen[0].episode.extras.get("table_height")
        note = f"; the table is at {height:g} m: set the policy's `keyframes.table_height`" if height else ""
        return f"pins from the table to the tool, the left arm's orange, the right one's blue; square: not in it{note}"
    from ugr_lightning.data.selection import shorten

    missing = shorten(list(dict.fromkeys(what for each in lacks.values() for what in each)), 3)
    where = f" in {', '.join(lacks)}" if len(lacks) < len(found.seen[0].views) else ""
    return f"none, so that no policy with `keyframes` learns from them; missing{where}: {missing}"


def _statistics(found: "Inspection") -> list[str]:
    """A table of all columns of both vectors."""
    lines = []
    for vector in ("state", "action"):
        rows, names = found.rows(vector), found.names(vector)
        values = np.concatenate(rows).astype(np.float64)  # (N, D)
        steps = np.concatenate([np.zeros((1, values.shape[1])), *(np.abs(np.diff(one, axis=0)) for one in rows)])
        table = np.stack([values.min(0), values.max(0), values.mean(0), values.std(0), steps.max(0)], axis=1)  # (D, 5)
        table = table.round(6) + 0.0  # -0 and rounding errors are 0
        width = max(16, *(len(name) for name in names))
        heads = "".join(f"{head:>11}" for head in ("lowest", "highest", "mean", "std", "fastest"))
        lines.append(f"{vector:<{width}}  {heads}  ({len(names)} columns; fastest: largest change in a step)")
        lines += [
            f"  {name:<{width}}{''.join(f'{number:>11.4g}' for number in row)}"
            for name, row in zip(names, table, strict=True)
        ]
    return lines


def _sheet_name(place: Path) -> str:
    """What a contact sheet is called: `task-setting.png`, or `task-setting-episode7.png` of a single file.

    With more of the path in front where another one has that name.
    """
    whole = place.resolve()
    parts = [part for part in (whole.with_suffix("") if place.is_file() else whole).parts[1:] if part != "data"]
    shortest = 3 if place.is_file() else 2
    names = ["-".join(parts[-count:]) + ".png" for count in range(shortest, max(len(parts), shortest) + 1)]
    return next((name for name in names if _who_has(Path(name), place) is None), names[-1])


def _sheet_mark(place: Path) -> str:
    """What a contact sheet says of itself, in the head of the file."""
    return f"contact sheet of {place.resolve()}\n"


def _who_has(sheet: Path, place: Path) -> str | None:
    """What keeps a contact sheet from being written; None where nothing does."""
    if not sheet.exists():
        return None
    try:
        with sheet.open("rb") as file:
            return None if _sheet_mark(place).encode() in file.read(HEAD_BYTES) else "another file"
    except OSError as error:
        return str(error)


def _check_sheet(sheet: Path, place: Path) -> None:
    """Nothing may be where the contact sheet goes but an earlier one of the same demonstrations."""
    got = _who_has(sheet, place) if place.exists() else None
    if got is not None:
        fix = "Move it away, or choose another place: `--picture FILE.png`."
        raise DataError(sheet, f"nothing, or an earlier contact sheet of {place}", got, fix)


def _contact_sheet(found: "Inspection", path: Path) -> str:
    """Write a PNG of some steps and say what it shows; rows are steps, columns are cameras.

    Cameras of different sizes are shown at the size of the first.
    """
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    from ugr_lightning.system.files import publish

    height, width = next(iter(found.seen[0].views.values())).size
    rows, said = [], []
    for one in (one for one in found.seen if one.steps):
        for pictures in zip(*(view.shown for view in one.views.values()), strict=True):
            tiles = [Image.fromarray(picture) for picture in pictures]
            same = [tile if tile.size == (width, height) else tile.resize((width, height)) for tile in tiles]
            rows.append(np.concatenate([np.asarray(tile) for tile in same], axis=1))  # (H, V W, 3)
        said.append(f"{one.index}: {', '.join(map(str, one.steps))}")
    about = PngInfo()
    about.add_itxt("Title", _sheet_mark(found.folder))
    sheet = Image.fromarray(np.concatenate(rows, axis=0))
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        publish(path, lambda partial: sheet.save(partial, format="PNG", pnginfo=about))
    except OSError as error:
        raise DataError(path, "a place for the contact sheet", str(error), "Choose another: `--picture`.") from error
    return f"{path}: columns {', '.join(found.seen[0].views)}; rows episode: steps {'; '.join(said)}"


def convert_data(
    source: str,
    target: str,
    to: str,
    cameras: list[str] | None = None,
    layout: Layout | None = None,
    tasks: str | list[str] | None = None,
    episodes: int | list[int] | None = None,
    rate: float | None = None,
) -> int:
    """Write demonstrations of any format that is recognised again in another one; goes on where it was stopped.

    Everything is read and checked first; states and actions are read back and compared to the bit at last.

    Args:
        source: a folder or a file.
        target: a folder that is empty, new, or was begun by the same command.
        to: `robotwin`, `act`, `original-act` or `lerobot`.
        cameras: cameras to write, by the names that a policy would use; null for all.
        layout: joints and cameras as a policy would see them; null for everything as it is.
        tasks: only episodes of these tasks, by name or by pattern (`click_*`), where the data name them.
        episodes: only the first so many, or those with these numbers; null for all.
        rate: steps per second, where the files do not say it or the target needs another number; null for theirs.
    """
    from ugr_lightning.data.conversion import convert, left_out
    from ugr_lightning.data.formats import find_format
    from ugr_lightning.data.selection import Selection
    from ugr_lightning.system.progress import Progress

    if rate is not None and not 1e-3 <= rate <= 1e5:
        raise ConfigError("--rate", "a number of steps per second above 0, and no more than 1e5", rate, "Correct it.")
    with ExitStack() as stack:
        bars: dict[str, Progress] = {}

        def done(what: str, number: int, total: int) -> None:
            if what not in bars:
                stack.close()
                bars[what] = stack.enter_context(Progress(what, total))
            bars[what].advance()

        selection = Selection(tasks or (), episodes)
        options = {"cameras": cameras, "layout": layout, "rate": rate, "selection": selection}
        found = convert(Path(source), Path(target), to, done=done, **options)  # type: ignore[arg-type]
        lost = left_out(find_format(to), Path(target), found, done)
    steps = sum(episode.length for episode in found)
    print(f"{target}: {len(found)} episodes, {steps} steps as {to}; states and actions are the same to the bit")
    print(f"cameras     {', '.join(found[0].cameras)}")
    print(f"left out    {', '.join(lost) or 'nothing'}")
    return 0


FUNCTIONS: dict[str, tuple[Callable[..., int], tuple[str, ...]]] = {
    "inspect": (inspect_data, ("path",)),
    "convert": (convert_data, ("source", "target")),
}
run = partial(call_one_of, FUNCTIONS)

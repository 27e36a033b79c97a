"""`ugr view`: look at a demonstration, a policy's predictions on it, or a rollout."""

import os
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path

from ugr_lightning.cli.parsing.call import Count, call
from ugr_lightning.errors import ConfigError, DataError
from ugr_lightning.training.runs import or_best, resolve_checkpoint

DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")
"""Environment variables, one of which Linux needs for a window."""


def _view(
    path: str,
    episode: int | None = None,
    checkpoint: str | None = None,
    run: str | None = None,
    root: str = "runs",
    stride: Count = 5,
    out: str | None = None,
) -> int:
    """Open a timeline in the rerun viewer: cameras, joints, commands, phases, contacts, predicted chunks and s_k.

    Args:
        path: demonstrations of any format, a folder or a file; or a trace from `ugr rollout --traces`.
        episode: which demonstration; null for the first.
        checkpoint: `best`, `best_loss`, `last`, or a checkpoint file, to see what it predicts along the demonstration;
            null takes `best` of a `run` that is given.
        run: name or folder of a run; null takes the newest run.
        root: folder of all runs.
        stride: control steps between two of its predictions.
        out: write this `.rrd` file in place of opening a viewer.
    """
    place = Path(path).expanduser()
    if not place.exists():
        raise DataError(place, "demonstrations or a trace", "nothing there", "Check the path.")
    if place.suffix == ".ckpt":
        fix = f"Say along which demonstrations: `ugr view FOLDER --checkpoint {path}`."
        raise ConfigError("ugr view", "demonstrations or a trace", "a checkpoint", fix)
    checkpoint = or_best(checkpoint, run)
    file = None if checkpoint is None else resolve_checkpoint(checkpoint, run, root)
    if out is not None:
        _write(place, episode, file, stride, Path(out).expanduser())
        print(f"timeline: {out} (`rerun {out}` opens it)")
        return 0
    if sys.platform == "linux" and not any(map(os.environ.get, DISPLAYS)):
        fix = f"Write a file, and open it where there is one: `ugr view {path} --out view.rrd`, then `rerun view.rrd`."
        raise ConfigError("ugr view", "a display to open a window on", "none", fix)
    with tempfile.TemporaryDirectory() as folder:
        timeline = Path(folder) / f"{place.stem}.rrd"
        _write(place, episode, file, stride, timeline)
        return subprocess.call([sys.executable, "-m", "rerun", str(timeline)])


run = partial(call, _view, leading=["path"])


def _write(place: Path, episode: int | None, checkpoint: Path | None, stride: int, out: Path) -> None:
    from ugr_lightning.data.formats import detect
    from ugr_lightning.data.layout import Layout
    from ugr_lightning.data.selection import ranges
    from ugr_lightning.demos.timeline import predict_along, write_demonstration, write_rollout
    from ugr_lightning.models.checkpoint import load_policy
    from ugr_lightning.rollout.traces import read_traces

    if place.suffix == ".npz":
        trace = read_traces([place])[0]
        return write_rollout(out, trace, tuple(map(str, range(trace.chunks.shape[2]))))
    form = detect(place)
    locations = form.find(place)
    index = min(locations) if episode is None else episode
    if index not in locations:
        got = f"{index}; there are {ranges(locations)}"
        raise ConfigError("--episode", "one of the demonstrations", got, "Choose another.")
    contents = form.peek(locations[index])
    if checkpoint is None:
        demonstration = form.read(locations[index], contents.cameras, contents.layout)
        return write_demonstration(out, demonstration, contents.action)
    policy, info = load_policy(checkpoint)
    layout = Layout.of_training(info.data)
    demonstration = form.read(locations[index], policy.cameras, layout)
    plans = predict_along(policy.for_inference(), demonstration, info.data, stride, place)
    return write_demonstration(out, demonstration, layout.names(contents.action, "action"), plans)

"""`ugr inspect`: what a checkpoint, an episode or a folder is."""

import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ugr_lightning.cli.parsing.call import call
from ugr_lightning.errors import CheckpointError, DataError


def _inspect(path: str, picture: str | None = None) -> int:
    """Say what a checkpoint, an episode or a folder is.

    Args:
        path: a `.ckpt` file, an exported folder, a folder of runs, or demonstrations, see `ugr data inspect`.
        picture: for demonstrations, where the contact sheet goes, in place of an earlier one of the same at most; null
            means `TASK-SETTING.png`, after the last two folders, in the working folder.
    """
    from ugr_lightning.cli.data import inspect_data
    from ugr_lightning.data.formats import recognise

    place = Path(path)
    if (place / "model.safetensors").is_file():
        lines = _checkpoint(place)
    elif recognise(place) or place.suffix in (".hdf5", ".h5"):
        return inspect_data(path, picture=picture)
    elif place.is_dir():
        lines = _runs(place)
    elif place.is_file():
        lines = _checkpoint(place)
    else:
        raise DataError(place, "a checkpoint, an episode or a folder", "nothing there", "Check the path.")
    print("\n".join(lines))
    return 0


run = partial(call, _inspect, leading=["path"])


def _checkpoint(path: Path) -> list[str]:
    from ugr_lightning.models.checkpoint import load_policy

    policy, info = load_policy(path)
    count = sum(parameter.numel() for parameter in policy.parameters())
    about = info.description
    split = info.data.get("split") or {}
    lines = [
        f"{path}: checkpoint of {about['blueprint']['class_path']}, {count / 1e6:.2f} M parameters",
        f"sha256        {info.sha256}",
        f"trained       {info.step} steps, {info.epoch + 1} epochs",
        f"chunk         {about['chunk_length']} x {about['action_dim']} actions from {about['state_dim']} states",
        f"cameras       {', '.join(about['cameras'])}",
        *(f"{name:<13} {value}" for name, value in info.data.items() if name != "split"),
        *(f"split         {part}: {_short(members)}" for part, members in split.items()),
        *_alarms(path, info.sha256),
        f"versions      {', '.join(f'{name} {number}' for name, number in about['versions'].items())}",
        f"arguments     {json.dumps(about['blueprint']['init_args'])}",
        "statistics and other buffers:",
    ]
    return lines + [
        f"  {name}: {_numbers(buffer)}"
        for name, buffer in policy.named_buffers()
        if not any(part in name for part in ("backbone", "finder.zoom"))  # their layers' running statistics
    ]


def _alarms(path: Path, sha256: str) -> list[str]:
    from ugr_lightning.rollout.alarm import read_alarms

    try:
        return [f"alarm         {alarm}" for alarm in read_alarms(path, sha256).values()]
    except CheckpointError as error:
        return [f"alarm         {error}"]


def _short(members: Any) -> str:
    return f"{len(members)}: {', '.join(map(str, members[:8]))} ..." if isinstance(members, list) else str(members)


def _numbers(values: Any) -> str:
    array = np.atleast_1d(values.detach().cpu().numpy())
    shown = np.array2string(array.ravel()[:14], precision=3, suppress_small=True, max_line_width=200)
    return f"{tuple(array.shape)} {shown}"


def _runs(folder: Path) -> list[str]:
    from ugr_lightning.models.checkpoint import read_checkpoint

    lines = []
    for path in sorted(folder.rglob("*.ckpt")):
        try:
            said = f"step {read_checkpoint(path, mmap=True).get('global_step')}"
        except CheckpointError as error:
            said = f"cannot be read ({error.got})"
        lines.append(f"{path}: {said}, {path.stat().st_size / 2**20:.1f} MiB")
    if not lines:
        from ugr_lightning.data.formats import detect

        detect(folder)  # says which demonstrations would have been known
    return lines

"""`ugr inspect`: what a checkpoint, an episode or a folder is."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ugr_lightning.errors import DataError


def run(command: str, argv: Sequence[str]) -> int:
    """Run `ugr inspect`."""
    from ugr_lightning.cli.call import call

    if argv and not argv[0].startswith("-"):  # `ugr inspect PATH`
        argv = ["--path", *argv]
    return call(_inspect, command, argv)


def _inspect(path: str, picture: str | None = None) -> int:
    """Say what a checkpoint, an episode or a folder is.

    Args:
        path: a `.ckpt` file, an exported folder, an `.hdf5` episode, a folder of demonstrations, or a folder of runs.
        picture: for an episode, where its contact sheet goes; null means `<episode>.png` in the working folder.
    """
    place = Path(path)
    if (place / "model.safetensors").is_file():
        lines = _checkpoint(place)
    elif place.is_dir():
        lines = _recording(place) or _runs(place)
    elif place.suffix == ".hdf5":
        lines = _episode(place, Path(picture or f"{place.stem}.png"))
    elif place.is_file():
        lines = _checkpoint(place)
    else:
        raise DataError(place, "a checkpoint, an episode or a folder", "nothing there", "Check the path.")
    print("\n".join(lines))
    return 0


def _checkpoint(path: Path) -> list[str]:
    from ugr_lightning.training.checkpoint import load_policy

    policy, info = load_policy(path)
    count = sum(parameter.numel() for parameter in policy.parameters())
    about = info.description
    split = info.data.get("split") or {}
    lines = [
        f"{path}: checkpoint of {about['blueprint']['class_path']}, {count / 1e6:.2f} M parameters",
        f"sha256      {info.sha256}",
        f"trained     {info.step} steps, {info.epoch + 1} epochs",
        f"chunk       {about['chunk_length']} x {about['action_dim']} actions from {about['state_dim']} states",
        f"cameras     {', '.join(about['cameras'])}",
        *(f"{name:<12}{value}" for name, value in info.data.items() if name != "split"),
        *(f"split       {part}: {_short(members)}" for part, members in split.items()),
        f"versions    {', '.join(f'{name} {number}' for name, number in about['versions'].items())}",
        f"arguments   {json.dumps(about['blueprint']['init_args'])}",
        "statistics and other buffers:",
    ]
    return lines + [
        f"  {name}: {_numbers(buffer)}" for name, buffer in policy.named_buffers() if "backbone" not in name
    ]


def _short(members: Any) -> str:
    return f"{len(members)}: {', '.join(map(str, members[:8]))} ..." if isinstance(members, list) else str(members)


def _numbers(values: Any) -> str:
    array = np.atleast_1d(values.detach().cpu().numpy())
    shown = np.array2string(array.ravel()[:14], precision=3, suppress_small=True, max_line_width=200)
    return f"{tuple(array.shape)} {shown}"


def _episode(path: Path, picture: Path) -> list[str]:
    from ugr_lightning.contract import CAMERAS
    from ugr_lightning.data.formats.robotwin import read_episode

    episode = read_episode(path, CAMERAS)
    steps = np.linspace(0, episode.length - 1, min(8, episode.length)).astype(int)
    _contact_sheet([episode.images(int(step)) for step in steps], picture)
    moved = np.abs(np.diff(episode.action, axis=0)).max(0) if episode.length > 1 else np.zeros(episode.action.shape[1])
    return [
        f"{path}: one demonstration, {episode.length} decision steps",
        f"seed        {episode.seed}",
        f"cameras     {', '.join(episode.cameras)} at {episode.image_size[0]}x{episode.image_size[1]} (height x width)",
        f"state       {episode.state.shape} {episode.state.dtype}",
        f"action      {episode.action.shape} {episode.action.dtype}",
        f"  lowest    {np.round(episode.action.min(0), 3).tolist()}",
        f"  highest   {np.round(episode.action.max(0), 3).tolist()}",
        f"  fastest   {np.round(moved, 3).tolist()} per step",
        f"pictures    {picture}",
    ]


def _contact_sheet(frames: list[np.ndarray], path: Path) -> None:
    """Write pictures of some steps, one row per step and one column per camera.

    Args:
        frames: (V, H, W, 3) uint8 RGB each.
        path: PNG file.
    """
    from PIL import Image

    rows = [np.concatenate(list(frame), axis=1) for frame in frames]  # (H, V W, 3) each
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.concatenate(rows, axis=0)).save(path, format="PNG")


def _recording(folder: Path) -> list[str]:
    from ugr_lightning.contract import CAMERAS
    from ugr_lightning.data.folder import find_episodes, read_seeds
    from ugr_lightning.data.formats.robotwin import read_episode

    found = find_episodes(folder)
    if not found:
        return []
    episodes = [read_episode(path, CAMERAS) for path in found.values()]
    lengths = [episode.length for episode in episodes]
    seeds = read_seeds(folder)
    return [
        f"{folder}: {len(found)} demonstrations, all readable",
        f"steps       {min(lengths)} to {max(lengths)}, mean {np.mean(lengths):.0f}, {sum(lengths)} in all",
        f"pictures    {episodes[0].image_size[0]}x{episodes[0].image_size[1]} (height x width)",
        f"seeds       {_short(seeds) if seeds else 'none recorded'}",
    ]


def _runs(folder: Path) -> list[str]:
    from ugr_lightning.training.checkpoint import read_checkpoint

    lines = []
    for path in sorted(folder.rglob("*.ckpt")):
        content = read_checkpoint(path)
        lines.append(f"{path}: step {content.get('global_step')}, {path.stat().st_size / 2**20:.1f} MiB")
    if not lines:
        got = "neither episodes nor checkpoints"
        raise DataError(folder, "demonstrations or runs", got, "Record with `ugr collect`, or train with `ugr fit`.")
    return lines

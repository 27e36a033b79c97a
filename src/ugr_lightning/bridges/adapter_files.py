"""Folders that other projects import: written from the package's templates, and never over what somebody else wrote."""

import hashlib
import json
import re
import shutil
from collections.abc import Callable, Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

from ugr_lightning.errors import ConfigError
from ugr_lightning.rollout.alarm import alarms_path
from ugr_lightning.system.files import publish, publish_folder, publish_text

MARK = r"(Written by `ugr bridge \w+`)"
"""Every file of ours contains it, and behind it a digest of the file without the digest; other files are left alone."""


def _signed(text: str) -> str:
    """A file as it is written: with the digest of the rest of it."""
    plain = re.sub(MARK + r" \(\w{12}\)", r"\1", text, count=1)
    digest = hashlib.sha256(plain.encode()).hexdigest()[:12]
    return re.sub(MARK, rf"\1 ({digest})", plain, count=1)


def _write_folder(template: str, out: Path, values: Mapping[str, str]) -> list[Path]:
    """Fill `@NAME@` in the files of a template, which are called like the written ones, with `.txt` behind."""
    contents: dict[Path, str] = {}
    for source in sorted(files("ugr_lightning.bridges").joinpath("templates", template).iterdir(), key=str):
        body = source.read_text(encoding="utf-8")
        body = re.sub("@([A-Z_]+)@", lambda found: values[found[1]], body)
        contents[out / source.name.removesuffix(".txt")] = _signed(body)
    for path in contents:
        text = path.read_text(encoding="utf-8", errors="replace") if path.exists() else None
        if text is not None and not (re.search(MARK, text) and text == _signed(text)):
            got = "another one, one that was edited since, or of an earlier version"
            fix = "Move it away, or choose another folder."
            raise ConfigError(path, "a file as `ugr bridge` wrote it", got, fix)
    try:
        out.mkdir(parents=True, exist_ok=True)
        for path, content in contents.items():
            publish_text(path, content, mode=0o755 if path.suffix == ".sh" else 0o644)
    except OSError as error:
        raise ConfigError(out, "a folder that can be written", error, "Choose another folder.") from error
    return list(contents)


def write_adapter_folder(
    template: str,
    load: Callable[[dict[str, Any]], Any],
    checkpoint: Path,
    out: Path,
    *,
    execution: str | int = "aggregate",
    cameras: Mapping[str, str] | None = None,
    ignore_layout: bool = False,
    copy: bool = False,
) -> list[Path]:
    """Write a policy folder for another program, after loading the checkpoint as that program will.

    Args:
        template: folder under `templates`.
        load: makes the model from the folder's settings; it has a `deployment`.
        checkpoint: file from `ugr fit`, or the folder of `ugr export --to safetensors`.
        out: the folder, `policy/NAME` of a checkout of the other program.
        execution: see `Deployment`.
        cameras: the other program's names of the policy's cameras, where they differ from the usual ones.
        ignore_layout: the other program has its joints in the policy's order and units, though the training picked
            them from files that had not.
        copy: put the checkpoint into the folder; otherwise the folder points to where it is now.

    Returns:
        The files written.

    Raises:
        ConfigError: a file in it is not ours or was edited, it cannot be written, or its name cannot be imported.
        CheckpointError: the checkpoint cannot be evaluated.
    """
    if not out.name.isidentifier():
        fix = "It is imported by its name; use e.g. policy/UGR."
        raise ConfigError("--out", "a folder named like a Python module", out.name, fix)
    settings: dict[str, Any] = {"checkpoint": str(checkpoint.resolve()), "execution": execution}
    settings |= {"cameras": dict(cameras or {}), "ignore_layout": ignore_layout}
    used = load(settings).deployment.cameras
    named = "".join(f"\n  {json.dumps(ours)}: {json.dumps(name)}" for ours, name in used.items())
    place = out / (checkpoint.name if checkpoint.is_dir() else "policy_best.ckpt") if copy else checkpoint.resolve()
    values = {"POLICY": out.name, "EXECUTION": str(execution), "CAMERAS": named}
    values["IGNORE_LAYOUT"] = json.dumps(ignore_layout)
    values["CHECKPOINT"] = json.dumps(place.name if copy else str(place))  # JSON is YAML, whatever a path holds
    written = _write_folder(template, out, values)
    if not copy or place.resolve() == checkpoint.resolve():
        return written
    if checkpoint.is_dir():

        def write(aside: Path) -> None:
            shutil.copytree(checkpoint, aside, dirs_exist_ok=True)
            shutil.rmtree(place, ignore_errors=True)

        publish_folder(place, write)
    else:
        publish(place, lambda aside: shutil.copyfile(checkpoint, aside))
        ours, theirs = alarms_path(checkpoint), alarms_path(place)
        theirs.unlink(missing_ok=True)
        if ours.is_file():
            publish(theirs, lambda aside: shutil.copyfile(ours, aside))
            written.append(theirs)
    return [*written, place]

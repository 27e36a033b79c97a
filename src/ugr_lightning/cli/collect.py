"""`ugr collect`: demonstrations of the scripted experts; `ugr fit` records through it what a training lacks."""

import json
import warnings
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from ugr_lightning.cli.parsing.call import call
from ugr_lightning.cli.parsing.shard import every_nth
from ugr_lightning.demos.noise import Noise
from ugr_lightning.errors import DataError
from ugr_lightning.sim.tasks import all_task_names, task_version

if TYPE_CHECKING:
    from ugr_lightning.data.datamodule import ChunkDataModule


def _collect(
    task: str,
    episodes: int = 50,
    root: str = "data/160x120",
    setting: str = "demo_clean",
    image_size: tuple[int, int] = (120, 160),
    noise: Noise = Noise(),  # noqa: B008 - frozen
    workers: int = 2,
    video: bool = False,
    shard: str | None = None,
) -> int:
    """Record demonstrations of a task's scripted expert in RoboTwin 2.0's layout; goes on where it was stopped.

    Args:
        task: a name from `ugr tasks`, or `all` for one after another.
        episodes: how many each folder shall hold.
        root: where to; episodes are in `<root>/<task>/<setting>/data`.
        setting: `demo_clean` or `demo_randomized`.
        image_size: height and width of the pictures.
        noise: noise on the executed commands; the intended ones are the labels.
        workers: simulator processes.
        video: write a video of each episode as well.
        shard: `3/8` is the third of eight processes that record into the folder at the same time; its episodes wait
            there, until `1/1` or a training records what is missing and puts all in their order.
    """
    from ugr_lightning.demos.collect import collect as record
    from ugr_lightning.sim.settings import check_setting
    from ugr_lightning.sim.tasks import named_tasks

    check_setting(setting)
    part = every_nth(shard)
    for name in named_tasks(task):
        folder = Path(root) / name / setting
        record(
            name,
            folder,
            episodes=episodes,
            setting=setting,
            image_size=image_size,
            noise=noise,
            workers=workers,
            video=video,
            part=part,
        )
        whole = f"{episodes} demonstrations in {folder}"
        print(whole if part.step == 1 else f"shard {shard} of {whole}; --shard 1/1 completes them", flush=True)
    return 0


run = partial(call, _collect, leading=["task"])


def record_demonstrations(data: "ChunkDataModule") -> None:
    """Let the scripted expert fill the data module's folder, with the data module's own settings.

    Args:
        data: its `task`, `setting`, `episodes`, `folder` and `recording` say what is missing.

    Raises:
        ConfigError: no such setting.
    """
    from ugr_lightning.demos.collect import collect as record
    from ugr_lightning.sim.settings import check_setting

    check_setting(data.setting)
    recording = data.recording
    print(f"Recording demonstrations of {data.task} into {data.folder}", flush=True)
    record(
        data.task,
        data.folder,
        episodes=data.wanted,
        setting=data.setting,
        image_size=recording.image_size,
        noise=Noise(recording.noise_std, recording.noise_time_constant, recording.noise_bias),
        workers=recording.workers,
    )


def check_recording(data: "ChunkDataModule") -> None:
    """Make sure that the data module's folder was recorded as its `recording` says.

    What nobody asked for is only remarked on: a default that the folder does not have, or a newer version of the task.

    Args:
        data: its `task`, `folder` and `recording`; one that records nothing (`data.folder` is given) is left alone.

    Raises:
        DataError: the folder was recorded with something else than asked for, or its settings cannot be read.
    """
    path = data.folder / "recording.json"
    if data.elsewhere or not path.is_file():
        return
    try:
        found = json.loads(path.read_text())
        noise = {f"noise_{name}": value for name, value in found.get("noise", {}).items()}
        version, recorded = found.get("task_version"), {"image_size": found.get("image_size"), **noise}
    except (ValueError, AttributeError) as error:
        raise DataError(path, "the settings of a recording", error, "Restore the file.") from error
    asked, usual = (json.loads(json.dumps(asdict(one))) for one in (data.recording, type(data.recording)()))
    differing = [name for name, value in asked.items() if recorded.get(name) not in (None, value)]
    meant = [name for name in differing if asked[name] != usual[name]]
    if meant:
        expected, got = (", ".join(f"{name} {of[name]}" for name in meant) for of in (asked, recorded))
        fix = "Record into another folder (`data.root`), move this one away, or ask for what it has."
        raise DataError(data.folder, f"a recording with `data.recording` {expected}", got, fix)
    if differing:
        got = ", ".join(f"{name} {recorded[name]}" for name in differing)
        _remark(f"{data.folder} was recorded with {got}, not with the defaults of `data.recording`.")
    if data.task in all_task_names() and version not in (None, task_version(data.task)):
        _remark(
            f"{data.folder} was recorded with version {version} of {data.task}; here it is version "
            f"{task_version(data.task)}. Move the folder away to record anew."
        )


_remark = partial(warnings.warn, stacklevel=2)

"""A page of pictures: an expert's episode per task and setting, as a small GIF and as a sheet of stills."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from ugr_lightning.data.storage.jpeg import decode_picture, encode_frame
from ugr_lightning.demos.survey import FIRST_SEED
from ugr_lightning.embodiment import CAMERAS
from ugr_lightning.errors import SimulationError
from ugr_lightning.rollout.film import compose_frames, write_video
from ugr_lightning.sim.frame import Frame
from ugr_lightning.sim.registry import open_simulator
from ugr_lightning.system.files import publish, publish_text
from ugr_lightning.system.progress import Progress
from ugr_lightning.system.spread import spread

GIF_BYTES = 235_000
"""Ten of them and their stills stay below 3 MB."""

GIF_SIZE = (128, 96)
GIF_SPEED = 2
FRAME_COUNTS = (60, 48, 38, 30, 24, 19, 15, 12)
TRIES = 10


class Shot(NamedTuple):
    """An episode that was pictured.

    Args:
        task, setting, seed: which one.
        steps: control steps.
        gif, stills: file names in the gallery's folder.
    """

    task: str
    setting: str
    seed: int
    steps: int
    gif: str
    stills: str


class Photographer:
    """Pictures experts; lives in a worker process.

    Args:
        folder: where the pictures go.
        image_size: (H, W) of the stills.
        first_seed: the first seed from here on that the expert solves is shown.
    """

    def __init__(self, folder: Path, image_size: tuple[int, int], first_seed: int) -> None:
        self._folder, self._image_size, self._first_seed = folder, image_size, first_seed

    def shoot(self, subject: tuple[str, str]) -> Shot:
        """Picture a (task, setting).

        Raises:
            SimulationError: the expert solves none of the first seeds.
        """
        task, setting = subject
        simulator = open_simulator(task, setting=setting, image_size=self._image_size)
        try:
            for seed in range(self._first_seed, self._first_seed + TRIES):
                frames = [_packed(simulator.reset(seed))]
                frames += [_packed(simulator.step(intention.action)) for intention in simulator.expert()]
                if frames[-1][1]:
                    name = f"{task}-{setting}"
                    self._write_gif(self._folder / f"{name}.gif", frames, simulator.control_hz)
                    self._write_stills(self._folder / f"{name}.jpg", frames)
                    return Shot(task, setting, seed, len(frames) - 1, f"{name}.gif", f"{name}.jpg")
        finally:
            simulator.close()
        got = f"no success on the seeds {self._first_seed} to {self._first_seed + TRIES - 1}"
        got += f", the last because: {simulator.gave_up}" if simulator.gave_up else ""
        raise SimulationError(f"expert of {task}, {setting}", "a task that it solves", got, "Repair the expert.")

    def _write_gif(self, path: Path, frames: list[tuple[tuple[bytes, ...], bool]], control_hz: float) -> None:
        """As many frames as fit into the size allowed."""
        pictures = [_small(jpegs) for jpegs, _ in frames]
        for count in FRAME_COUNTS:
            every = max(1, -(-len(frames) // count))
            film = compose_frames(pictures, success=[success for _, success in frames], every=every)
            write_video(path, film, fps=GIF_SPEED * control_hz / every)
            if path.stat().st_size <= GIF_BYTES:
                return

    def _write_stills(self, path: Path, frames: list[tuple[tuple[bytes, ...], bool]]) -> None:
        """Start, middle and end from top to bottom, the cameras from left to right."""
        moments = (0, len(frames) // 2, len(frames) - 1)
        rows = [np.concatenate([decode_picture(jpeg) for jpeg in frames[step][0]], axis=1) for step in moments]
        stills = Image.fromarray(np.concatenate(rows))
        publish(path, lambda partial: stills.save(partial, format="JPEG", quality=80))


def _packed(frame: Frame) -> tuple[tuple[bytes, ...], bool]:
    return encode_frame(frame.images), bool(frame.success)


def _small(jpegs: tuple[bytes, ...]) -> np.ndarray:
    """(V, h, w, 3) uint8 at the size of the GIF."""
    images = [Image.fromarray(decode_picture(jpeg)).resize(GIF_SIZE, Image.Resampling.BOX) for jpeg in jpegs]
    return np.stack([np.asarray(image) for image in images])


def make_gallery(
    folder: str | Path,
    tasks: Sequence[str],
    settings: Sequence[str],
    *,
    image_size: tuple[int, int] = (240, 320),
    first_seed: int = FIRST_SEED,
    workers: int = 2,
) -> Path:
    """Picture the expert of every task in every setting and write `gallery.md`, which shows it all.

    Args:
        folder: where everything goes.
        tasks: names from `ugr tasks`.
        settings: names of settings.
        image_size: (H, W) of the stills; the GIFs are smaller.
        first_seed: the first seed from here on that the expert solves is shown.
        workers: simulator processes.

    Returns:
        The page.

    Raises:
        SimulationError: an expert does not solve its task, or a simulator was lost.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    subjects = [(task, setting) for task in tasks for setting in settings]
    build = partial(Photographer, folder, image_size, first_seed)
    shots: dict[int, Shot] = {}
    with Progress("gallery", len(subjects)) as line:
        for done in spread(build, "shoot", subjects, workers=workers):
            if done.fault is not None:
                fix = "Run the command again."
                raise SimulationError(", ".join(subjects[done.job]), "a simulator that works", done.fault, fix)
            shots[done.job] = done.value
            line.advance(done.value.gif)
    page = folder / "gallery.md"
    publish_text(page, _page([shots[index] for index in range(len(subjects))]))
    return page


def _page(shots: Sequence[Shot]) -> str:
    from ugr_lightning.sim.tasks import task_summaries

    summaries = task_summaries()
    parts = [
        "# Gallery",
        "Episodes of the scripted experts, made by `ugr tasks gallery FOLDER`. Left to right: "
        + ", ".join(f"`{camera}`" for camera in CAMERAS)
        + f". The GIFs, at {GIF_SPEED} times the speed, say the control step; a green frame is success. "
        "The stills show the start, the middle and the end.",
    ]
    for task in dict.fromkeys(shot.task for shot in shots):
        parts += [f"## {task}", summaries.get(task, "")]
        for shot in shots:
            if shot.task == task:
                about = f"{task} in {shot.setting}, seed {shot.seed}, {shot.steps} control steps"
                parts += [f"`{shot.setting}`, seed {shot.seed}, {shot.steps} control steps:"]
                parts += [f"![{about}]({shot.gif})", f"![{about}: start, middle and end]({shot.stills})"]
    return "\n\n".join(part for part in parts if part) + "\n"

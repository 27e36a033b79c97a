"""Demonstrations on disk to batches: recording what is missing, checking, splitting, caching, loading."""

import shlex
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import lightning
import numpy as np
import torch
from torch.utils.data import DataLoader

from ugr_lightning.contract import CAMERAS, CHUNK_LENGTH, Batch, Statistics
from ugr_lightning.data.chunks import AfterEnd, ChunkDataset, ProprioceptionKind
from ugr_lightning.data.episode import Episode
from ugr_lightning.data.formats import RECORDED, EpisodeFormat, EpisodeLocation, detect, episode_files, recognise
from ugr_lightning.data.layout import DEFAULT_LAYOUT, Layout
from ugr_lightning.data.sampling import BatchSampler, EpochOrder, Sampling
from ugr_lightning.data.selection import Selection, count_tasks, describe_tasks, told_strays
from ugr_lightning.data.split import Split, split_episodes
from ugr_lightning.data.statistics import compute_statistics
from ugr_lightning.data.storage.cache import Cache, open_frames
from ugr_lightning.errors import ConfigError, DataError
from ugr_lightning.system.progress import Progress
from ugr_lightning.system.signals import deaf_to_signals

MANY = 200
"""Demonstrations; reading and checking so many takes seconds, and how far it is gets shown."""


@dataclass(frozen=True)
class Recording:
    """How demonstrations are recorded when the folder lacks some.

    Args:
        noise_std: stationary standard deviation of the noise on executed joint commands, rad; 0 for none.
        noise_time_constant: how long that noise remembers, s.
        noise_bias: standard deviation of a constant joint offset drawn per episode, rad.
        image_size: (height, width) of the recorded pictures.
        workers: simulator processes.
    """

    noise_std: float = 0.04
    noise_time_constant: float = 0.5
    noise_bias: float = 0.0
    image_size: tuple[int, int] = (120, 160)
    workers: int = 2


DEFAULT_ROOT = "data/160x120"
DEFAULT_SAMPLING = Sampling()
DEFAULT_RECORDING = Recording()


class ChunkDataModule(lightning.LightningDataModule):
    """Action chunks from demonstrations of one task.

    After `setup`: `data` (`ChunkDataset` over all episodes), `episode_split`, `split` and `statistics`; `image_size`
    then is the size of the pictures, also where it was null. `elsewhere` says whether `folder` was given.

    Args:
        task: task name.
        root: folder of recordings; episodes are in `<root>/<task>/<setting>/data`.
        setting: scene setting, `demo_clean` or `demo_randomized`.
        episodes: how many demonstrations to use, by index from the lowest, or their numbers; 80 % train, 20 % validate.
        cameras: cameras to load, in the order the policy sees them.
        image_size: (height, width) to shrink pictures to; null for the recorded size.
        chunk_length: K, actions per chunk.
        batch_size: samples per batch and process.
        val_stride: validation uses every `val_stride`-th step of every validation episode.
        cache: decoded pictures in `ram`, in a `memmap` file kept beside the episodes, or `none`, decoded when used.
        num_workers: loader processes; batches do not depend on it.
        seed: seed of the order of training samples.
        split_seed: seed of the division into training and validation episodes.
        state: `commanded` joint targets (RoboTwin's) or `measured` joints.
        action_offset: 0, target k is the action commanded at t + k; -1 shifts by one as RoboTwin's training does.
        after_end: steps past an episode's end are `mask`ed from the losses, or supervised to `hold` the last command.
        observation_steps: T, observations per sample, the newest and those just before it.
        sampling: how training samples are drawn.
        recording: how missing demonstrations are recorded.
        folder: demonstrations that are elsewhere, of any format that is recognised, instead of `root`, `task` and
            `setting`; nothing is recorded there.
        layout: which cameras and joints of the files the policy sees, where they are not those of our robot.
        tasks: of a folder of several tasks, use those of these names or patterns (`click_*`); empty for all.
        normalise_over: whose numbers the statistics are of: training episodes, or all, as in Diffusion Policy's code.

    Source: docs/data.md.
    """

    recorder: "Callable[[ChunkDataModule], None] | None" = None
    """Records missing episodes into `folder`; set by the command line, None where no simulator is wanted."""

    def __init__(
        self,
        task: str = "click_alarmclock",
        root: str = DEFAULT_ROOT,
        setting: str = "demo_clean",
        episodes: int | tuple[int, ...] = 50,
        cameras: tuple[str, ...] = CAMERAS,
        image_size: tuple[int, int] | None = None,
        chunk_length: int = CHUNK_LENGTH,
        batch_size: int = 16,
        val_stride: int = 5,
        cache: Cache = "ram",
        num_workers: int = 0,
        seed: int = 0,
        split_seed: int = 0,
        state: ProprioceptionKind = "commanded",
        action_offset: int = 0,
        after_end: AfterEnd = "mask",
        observation_steps: int = 1,
        sampling: Sampling = DEFAULT_SAMPLING,
        recording: Recording = DEFAULT_RECORDING,
        folder: str | None = None,
        layout: Layout = DEFAULT_LAYOUT,
        tasks: str | tuple[str, ...] = (),
        normalise_over: Literal["train", "all"] = "train",
    ) -> None:
        super().__init__()
        for name, value, least in (
            ("episodes", episodes if isinstance(episodes, int) else len(episodes), 2),
            ("batch_size", batch_size, 1),
            ("val_stride", val_stride, 1),
            ("num_workers", num_workers, 0),
            ("seed", seed, 0),
            ("split_seed", split_seed, 0),
        ):
            if value < least:
                raise ConfigError(f"data.{name}", f"at least {least}", value, "Correct the number.")
        self.task, self.setting, self.episodes = task, setting, episodes
        self.elsewhere = folder is not None
        self.folder = (Path(root) / task / setting if folder is None else Path(folder)).expanduser()
        self.cameras, self.image_size, self.cache = tuple(cameras), image_size, cache
        self.chunk_length, self.batch_size, self.val_stride = chunk_length, batch_size, val_stride
        self.num_workers, self.seed, self.split_seed = num_workers, seed, split_seed
        self.state, self.action_offset, self.after_end = state, action_offset, after_end
        self.observation_steps, self.sampling, self.recording = observation_steps, sampling, recording
        self.layout, self.tasks = layout, (tasks,) if isinstance(tasks, str) else tuple(tasks)
        self.selection, self.normalise_over = Selection(self.tasks, episodes), normalise_over
        self.demonstrations: list[Episode] = []
        self._checked: list[Episode] = []  # by `prepare_data`, so that `setup` need not read them again

    def prepare_data(self) -> None:
        """Record the demonstrations that are missing, and build a `memmap` cache, in one process per machine.

        Raises:
            DataError: too few demonstrations, and nobody to record them.
        """
        if self.demonstrations:
            return
        if self.recorder is not None and not self.elsewhere:
            form, found = self._find()
            if len(found) < self.wanted and (form is None or form.name == RECORDED):
                self.recorder(self)
        self._say_what_is_used()
        if self.cache == "memmap":
            self._checked = self._read()
            open_frames(self._checked, self.cache, self.image_size, self.folder)

    def setup(self, stage: str | None = None) -> None:
        """Check the demonstrations, split them, compute statistics and decode; the second call does nothing."""
        if self.demonstrations:
            return
        episodes, self._checked = self._checked or self._read(), []
        self.episode_split: Split = split_episodes(len(episodes), self.split_seed)
        seen = self.episode_split.train if self.normalise_over == "train" else None
        self.statistics: Statistics = compute_statistics(episodes, seen, state=self.state)
        store = open_frames(episodes, self.cache, self.image_size, self.folder)
        self.image_size = self.image_size or episodes[0].image_size
        conventions = (self.state, self.action_offset, self.after_end, self.observation_steps)
        self.data = ChunkDataset(episodes, store, self.chunk_length, *conventions)
        self._after_rest = self.data.frames.after_rest(self.data.states, self.sampling.rest)  # (N,)
        self.demonstrations = episodes

    def _find(self) -> tuple[EpisodeFormat | None, dict[int, EpisodeLocation]]:
        """The format and the episodes of the folder; no format where nothing was recorded yet."""
        if not self.elsewhere and not episode_files(self.folder) and not recognise(self.folder):
            return None, {}
        form = detect(self.folder)
        return form, form.find(self.folder)

    @property
    def wanted(self) -> int:
        """How many demonstrations are asked for."""
        return self.episodes if isinstance(self.episodes, int) else len(self.episodes)

    @property
    def control_hz(self) -> float | None:
        """Steps per second of the demonstrations, after `setup`; None where they do not say it, or not one rate."""
        rates = {episode.extras.get("control_hz") for episode in self.demonstrations}
        return rates.pop() if len(rates) == 1 else None

    @property
    def command_names(self) -> tuple[str, ...]:
        """What the demonstrations call the policy's commands; positions in their vector as text without names."""
        form, chosen, _ = self._chosen()
        return self.layout.names(form.peek(next(iter(chosen.values()))).action, "action")

    def _chosen(self) -> tuple[EpisodeFormat, dict[int, EpisodeLocation], int]:
        """The format, the demonstrations that are used, and how many there are."""
        form, found = self._find()
        chosen = self.selection.choose(found, self.folder) if form else {}
        if form is None or len(chosen) < self.wanted:
            fix = f"Record them with `{self._command()}`, or say where they are."
            if form is not None and (self.elsewhere or form.name != RECORDED):
                fix = f"Set `data.episodes` to {len(chosen)} or less."
                if len(chosen) < 2:
                    fix = "Add others: at least 2 are needed, one to train and one to validate."
            of_tasks = f" of {', '.join(self.tasks)}" if self.tasks else ""
            raise DataError(self.folder, f"{self.wanted} demonstrations{of_tasks}", len(chosen), fix)
        return form, chosen, len(found)

    def _command(self) -> str:
        """What records what is missing, into the folder that is read."""
        words = f"ugr collect {self.task} --episodes {self.wanted}"
        if self.setting != "demo_clean":
            words += f" --setting {self.setting}"
        root = self.folder.parents[1]
        return words if str(root) == DEFAULT_ROOT else f"{words} --root {shlex.quote(str(root))}"

    def positions_of(self, tasks: str | Sequence[str]) -> set[int]:
        """Positions of the demonstrations of some tasks among those that are used; of all, where none is named.

        Args:
            tasks: names or patterns (`click_*`).

        Raises:
            ConfigError: a task that none of them is of.
        """
        _, chosen, _ = self._chosen()
        meant = Selection(tasks).choose(chosen, self.folder)
        return {position for position, number in enumerate(chosen) if number in meant}

    def _say_what_is_used(self) -> None:
        """One line where a folder has more demonstrations than are used, more tasks than one, or other files."""
        form, chosen, present = self._chosen()
        tasks = count_tasks(chosen.values())
        words = [f"{len(chosen)} of {present} demonstrations are used (`data.episodes`)"] * (len(chosen) < present)
        words += [f"{len(tasks)} tasks are mixed: {describe_tasks(tasks)} (`data.tasks`)"] * (len(tasks) > 1)
        words += told_strays(form.strays(self.folder))
        if words:
            print(f"{self.folder}: {'; '.join(words)}", file=sys.stderr)

    def _read(self) -> list[Episode]:
        form, chosen, _ = self._chosen()
        episodes = []
        with Progress(f"reading {self.folder}", len(chosen), shown=len(chosen) >= MANY) as line:
            for location in chosen.values():
                episodes.append(form.read(location, self.cameras, self.layout))
                line.advance()
        return episodes

    @property
    def split(self) -> dict[str, Any]:
        """Which episodes train and which validate, as plain containers for a checkpoint."""
        parts = {"train": self.episode_split.train, "validation": self.episode_split.validation}
        named = {name: [self.demonstrations[i].name for i in part] for name, part in parts.items()}
        seeds = {f"{name}_seeds": [self.demonstrations[i].seed for i in part] for name, part in parts.items()}
        return {"split_seed": self.split_seed, **named, **seeds}

    def train_order(self, epoch: int) -> np.ndarray:
        """The frames of a training epoch, (n,) int64, for all processes together."""
        return self._after_rest[self.data.frames.draw(self.episode_split.train, self.sampling, self.seed, epoch)]

    def train_dataloader(self) -> DataLoader:
        """Batches of one epoch of training; continues in the middle of an epoch when the trainer does."""
        loader = self._loader(self.train_order)
        if isinstance(loader.sampler, BatchSampler):
            loader.sampler.resume(*self._position())
        return loader

    def val_dataloader(self) -> DataLoader:
        """The fixed grid of (episode, step) over the validation episodes, the same every time."""
        grid = np.unique(self._after_rest[self.data.frames.of(self.episode_split.validation, self.val_stride)])
        return self._loader(lambda epoch: grid)

    def _loader(self, order: EpochOrder) -> DataLoader:
        trainer: Any = self.trainer
        common: dict[str, Any] = {
            "num_workers": self.num_workers,
            "persistent_workers": self.num_workers > 0,
            "pin_memory": torch.cuda.is_available(),
            "collate_fn": _as_it_is,
            "worker_init_fn": deaf_to_signals,
        }
        if trainer is not None and trainer.overfit_batches > 0:
            # Lightning replaces every sampler of ours then, by one that goes through single frames in order.
            return DataLoader(self.data, batch_size=self.batch_size, **common)
        replicas, rank = (1, 0) if trainer is None else (trainer.world_size, trainer.global_rank)
        sampler = BatchSampler(order, self.batch_size, replicas, rank)
        return _ResumableLoader(self.data, batch_size=None, sampler=sampler, **common)

    def _position(self) -> tuple[int, int]:
        """Epoch and batches already trained on, as the trainer's loops were restored from a checkpoint.

        Lightning draws the first batches of a resumed run before it tells samplers the epoch.
        """
        if self.trainer is None:
            return 0, 0
        loop: Any = self.trainer.fit_loop
        epochs, batches = loop.epoch_progress.current, loop.epoch_loop.batch_progress
        if epochs.ready <= epochs.processed:  # between two epochs
            return epochs.processed, 0
        if batches.is_last_batch:
            return epochs.processed + 1, 0
        return epochs.processed, batches.current.processed


class _ResumableLoader(DataLoader):
    """Tells Lightning that it may resume in the middle of an epoch: the position is known from its own progress."""

    def state_dict(self) -> dict[str, Any]:
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        pass


def _as_it_is(batch: Batch) -> Batch:
    return batch

"""Which frames make up an epoch and its batches: a pure function of (seed, epoch, index).

No loader, worker or process keeps a random state, so any number of workers or processes sees the same samples, and a
resumed run continues where it was without a stored loader state.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
from torch.utils.data import DistributedSampler

from ugr_lightning.errors import ConfigError

EpochOrder = Callable[[int], np.ndarray]


@dataclass(frozen=True)
class Sampling:
    """How training frames are drawn.

    Args:
        mode: `uniform`, every frame is equally likely and none repeats before all were seen; or `per_episode`, one
            random frame of each training episode per round (the original ACT).
        samples_per_epoch: number of samples in an epoch; None for one round (all frames, or all episodes).
        first_frame_share: share of samples, 0 to 1, replaced by the first frame of a random training episode.
        rest: a frame from which on the joints stay nearer than this, robot units, is replaced by the last such frame,
            so that no target says how long to rest on: no picture tells how long it has been. 0 for off.
    """

    mode: Literal["uniform", "per_episode"] = "uniform"
    samples_per_epoch: int | None = None
    first_frame_share: float = 0.0
    rest: float = 0.0

    def __post_init__(self) -> None:
        if self.mode not in ("uniform", "per_episode"):
            raise ConfigError("data.sampling.mode", "`uniform` or `per_episode`", self.mode, "Correct the name.")
        if self.samples_per_epoch is not None and self.samples_per_epoch < 1:
            fix = "Correct the number."
            raise ConfigError("data.sampling.samples_per_epoch", "at least 1, or null", self.samples_per_epoch, fix)
        if not 0 <= self.first_frame_share <= 1:
            where = "data.sampling.first_frame_share"
            raise ConfigError(where, "a share from 0 to 1", self.first_frame_share, "Correct the number.")
        if not 0 <= self.rest < math.inf:
            raise ConfigError("data.sampling.rest", "0 or a distance above it", self.rest, "Correct the number.")


class Frames:
    """All decision steps of a data set in one row: the frame of episode e at step t is `starts[e] + t`.

    Args:
        lengths: number of decision steps of each episode.
    """

    def __init__(self, lengths: Sequence[int]) -> None:
        self.lengths = np.asarray(lengths, dtype=np.int64)  # (E,)
        self.starts = np.concatenate([[0], np.cumsum(self.lengths)[:-1]]).astype(np.int64)  # (E,)

    def __len__(self) -> int:
        return int(self.lengths.sum())

    def locate(self, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Episode and step of each frame, two (B,) int64 arrays."""
        episodes = np.searchsorted(self.starts, frames, side="right") - 1
        return episodes, frames - self.starts[episodes]

    def of(self, episodes: Sequence[int], stride: int = 1) -> np.ndarray:
        """Every `stride`-th frame of some episodes from their first on, in order."""
        return np.concatenate([self.starts[e] + np.arange(0, self.lengths[e], stride) for e in episodes])

    def after_rest(self, states: np.ndarray, rest: float) -> np.ndarray:
        """Which frame stands for each: the last before the joints leave where they are.

        The first frame of an episode stands for itself, as every rollout begins with it; so do those that rest until
        the end.

        Args:
            states: (N, S) joints at every frame.
            rest: how far the joints are from it when they have left, in any dimension, robot units.

        Returns:
            (N,) int64 frames.
        """
        stands = np.arange(len(self))
        last = np.repeat(self.starts + self.lengths - 1, self.lengths)  # (N,)
        still, ahead = np.setdiff1d(stands, self.starts), 0  # (n,) frames that the joints have not left so far
        while len(still):
            stands[still], ahead = still + ahead, ahead + 1
            ended = still + ahead > last[still]
            stands[still[ended]] = still[ended]
            still = still[~ended]
            near = np.abs(states[still + ahead] - states[still]) < rest  # (n, S)
            still = still[near.all(axis=1)]
        return stands

    def draw(self, episodes: Sequence[int], sampling: Sampling, seed: int, epoch: int) -> np.ndarray:
        """The training frames of one epoch, in order.

        Args:
            episodes: training episodes.
            sampling: how to draw.
            seed: training seed.
            epoch: number of the epoch.

        Returns:
            (n,) int64, the same for the same arguments.
        """
        rng = np.random.Generator(np.random.Philox(np.random.SeedSequence([seed, epoch])))
        every, lengths = self.of(episodes), self.lengths[list(episodes)]
        round_size = len(every) if sampling.mode == "uniform" else len(lengths)
        count = sampling.samples_per_epoch or round_size
        rounds = []
        for _ in range(-(-count // round_size)):
            if sampling.mode == "uniform":
                rounds.append(rng.permutation(every))
            else:
                rounds.append(rng.permutation(self.starts[list(episodes)] + rng.integers(0, lengths)))
        drawn = np.concatenate(rounds)[:count]
        replaced = rng.random(count) < sampling.first_frame_share
        firsts = self.starts[rng.choice(np.asarray(episodes), size=count)]
        return np.where(replaced, firsts, drawn)


def deal(order: np.ndarray, batch_size: int, replicas: int, rank: int) -> list[np.ndarray]:
    """One process's batches of an epoch; together the processes see every sample exactly once.

    All processes get the same number of batches, as gradient averaging requires. When the last samples are too few for
    every process to have one, they join the batches before.

    Args:
        order: (n,) the samples of the epoch, n at least `replicas`.
        batch_size: samples per batch and process.
        replicas: number of processes.
        rank: number of this process.
    """
    shared = batch_size * replicas
    cuts = [*range(0, len(order), shared), len(order)]
    if len(cuts) > 2 and cuts[-1] - cuts[-2] < replicas:
        del cuts[-2]
    return [order[start:stop][rank::replicas] for start, stop in pairwise(cuts)]


class BatchSampler(DistributedSampler):
    """Yields lists of frames, one list per batch of this process.

    It is a `DistributedSampler`, so that Lightning tells it the epoch and leaves the sharding to it.

    Args:
        order: epoch number -> (n,) samples; n is the same in every epoch.
        batch_size: samples per batch and process.
        replicas: number of processes.
        rank: number of this process.

    Raises:
        ConfigError: fewer samples than processes.
    """

    def __init__(self, order: EpochOrder, batch_size: int, replicas: int = 1, rank: int = 0) -> None:
        first = order(0)
        if len(first) < replicas:
            fix = "Use fewer processes or more demonstrations."
            raise ConfigError("trainer.devices", f"at most {len(first)} processes", replicas, fix)
        super().__init__(range(len(first)), num_replicas=replicas, rank=rank, shuffle=False)  # type: ignore[arg-type]
        self.order, self.batch_size = order, batch_size
        self.batches = len(deal(first, batch_size, replicas, rank))
        self._resumed: tuple[int, int] = (0, 0)

    def resume(self, epoch: int, batches: int) -> None:
        """Start in the middle: the first `batches` batches of `epoch` have been trained on."""
        self.set_epoch(epoch)
        self._resumed = (epoch, batches)

    def __len__(self) -> int:
        return self.batches

    def __iter__(self) -> Iterator[list[int]]:
        # Not a generator: the epoch counts as of now, however late or early a loader draws its first batch.
        epoch, done = self._resumed
        dealt = deal(self.order(self.epoch), self.batch_size, self.num_replicas, self.rank)
        return iter([batch.tolist() for batch in dealt[done if epoch == self.epoch else 0 :]])

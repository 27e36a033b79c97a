"""Random numbers as a pure function of (seed, epoch, batch, rank), so that resuming needs no generator state."""

import hashlib
import os
import random
from typing import Any

import numpy as np
import torch
from lightning.pytorch import Callback, LightningModule, Trainer


class CounterSeeds(Callback):
    """Seeds every generator before each training batch from the batch's own counters.

    Whatever ran in between (a validation, rollouts, a figure, a restart after a kill) then cannot change what dropout
    and the latent draw next: the resumed run is the uninterrupted one.

    Args:
        seed: base seed; the command line links it to `seed_everything`.
    """

    def __init__(self, seed: int | None = None) -> None:
        self.seed = int(os.environ.get("PL_GLOBAL_SEED", "0")) if seed is None else seed

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        seed = counter_seed(self.seed, trainer.current_epoch, batch_idx, trainer.global_rank)
        torch.manual_seed(seed)
        np.random.seed(seed % 2**32)
        random.seed(seed)


def counter_seed(*counters: int) -> int:
    """A 63-bit seed that any change of any counter changes.

    Args:
        counters: for example seed, epoch, batch, rank.
    """
    digest = hashlib.blake2b(",".join(map(str, counters)).encode(), digest_size=8).digest()
    return int.from_bytes(digest, "little") >> 1

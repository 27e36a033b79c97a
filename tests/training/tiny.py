"""A policy and data of a few numbers that go through the same training as the real ones."""

import os
from typing import Any

import torch
from lightning.pytorch import LightningDataModule
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset, DistributedSampler

from ugr_lightning.contract import Batch, Chunk, ChunkPolicy, Observation, Statistics

K, A, S = 5, 3, 3
EPISODES, STEPS = 4, 6


class TinyPolicy(ChunkPolicy):
    def __init__(self, width: int = 8, poison_at: int = -1) -> None:
        super().__init__()
        self.cameras, self.chunk_length, self.state_dim, self.action_dim = ("cam_high",), K, S, A
        self.poison_at, self.calls = poison_at, 0
        self.trunk = nn.Sequential(nn.Linear(S, width), nn.BatchNorm1d(width), nn.ReLU(), nn.Dropout(0.2))
        self.head = nn.Linear(width, K * A)
        self.uncertainty = nn.Linear(width, K)
        self.register_buffer("mean", torch.zeros(A))

    def set_statistics(self, statistics: Statistics) -> None:
        self.mean.copy_(statistics.action_mean)

    def plan(self, state: Tensor) -> tuple[Tensor, Tensor]:
        hidden = self.trunk(state)
        return self.head(hidden).unflatten(1, (K, A)) + self.mean, self.uncertainty(hidden)

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        actions, log_variance = self.plan(batch.state)
        error = (actions - batch.actions).square().mean(-1)[batch.valid].mean()
        self.calls += self.training
        if self.training and self.calls == self.poison_at:
            error = error * float("nan")
        spread = 0.01 * log_variance.square().mean()
        return {"loss": error + spread, "coarse": error, "uncertainty": spread}

    @torch.no_grad()
    def predict(self, observation: Observation) -> Chunk:
        actions, log_variance = self.plan(observation.state)
        refined = torch.zeros_like(log_variance, dtype=torch.bool)
        refined[:, :2] = True
        return Chunk(actions, actions + 0.1 * refined[..., None], log_variance, refined)


class TinySamples(Dataset):
    def __init__(self, episodes: range) -> None:
        self.index = [(e, t) for e in episodes for t in range(STEPS)]
        self.log = os.environ.get("TINY_LOG")

    def __len__(self) -> int:
        return len(self.index)

    def __getitem__(self, i: int) -> Batch:
        e, t = self.index[i]
        draw = torch.Generator().manual_seed(1000 * e + t)
        state = torch.randn(S, generator=draw)
        actions = (state + torch.linspace(0, 1, K)[:, None]).sin()
        valid = torch.arange(K) < STEPS - t
        images = torch.zeros(1, 3, 4, 4, dtype=torch.uint8)
        return Batch(images, state, actions, valid, torch.tensor(e), torch.tensor(t))


def collate(samples: list[Batch]) -> Batch:
    return Batch(*(torch.stack(column) for column in zip(*samples, strict=True)))


class Order(torch.utils.data.Sampler):
    """A permutation that is a pure function of the epoch."""

    def __init__(self, n: int) -> None:
        self.n, self.epoch = n, 0

    def set_epoch(self, epoch: int) -> None:
        self.epoch = epoch

    def __len__(self) -> int:
        return self.n

    def __iter__(self):
        return iter(torch.randperm(self.n, generator=torch.Generator().manual_seed(self.epoch)).tolist())


class TinyData(LightningDataModule):
    task, setting, image_size = "click_alarmclock", "demo_clean", (4, 4)

    def __init__(self, batch_size: int = 4) -> None:
        super().__init__()
        self.batch_size = batch_size
        ones = torch.ones(A)
        self.statistics = Statistics(0 * ones, ones, -ones, ones, 0.25 * ones, ones, -ones, ones)

    @property
    def split(self) -> dict[str, Any]:
        return {"train": [0, 1, 2], "validation": [3]}

    def train_dataloader(self) -> DataLoader:
        data = TinySamples(range(EPISODES - 1))
        sampler = DistributedSampler(data) if torch.distributed.is_initialized() else Order(len(data))
        return DataLoader(data, self.batch_size, sampler=sampler, collate_fn=collate)

    def val_dataloader(self) -> DataLoader:
        return DataLoader(TinySamples(range(EPISODES - 1, EPISODES)), self.batch_size, collate_fn=collate)

"""A refinement that reaches for a policy that was trained without one; what the policy was taught stays as it is."""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from ugr_lightning.blueprint import rebuild
from ugr_lightning.data.datamodule import ChunkDataModule
from ugr_lightning.errors import ConfigError
from ugr_lightning.models.act import ACT
from ugr_lightning.models.reach import Reach, require_arms
from ugr_lightning.models.refine.full import Full
from ugr_lightning.uncertainty.predictions import batches

STEPS, ROWS, RATE, DECAY = 1500, 32, 1e-3, 1e-2


class Known(NamedTuple):
    """What n coarse chunks were made of, and what was demonstrated.

    Args:
        hidden: (n, K, D) float16.
        coarse, shown: (n, K, A) robot units.
        points: (n, 2, 3) where the tools' next keyframes were seen, m.
        valid: (n, K) bool.
    """

    hidden: Tensor
    coarse: Tensor
    points: Tensor
    shown: Tensor
    valid: Tensor


def with_reach(policy: ACT) -> ACT:
    """A copy of a policy whose refinement, whatever it was, reaches; it has learned nothing yet, and acts coarsely.

    Args:
        policy: one that looks for keyframes.

    Raises:
        ConfigError: it does not look for them.
    """
    built, foresees = policy.blueprint(), policy.uncertainty_head is not None
    changed = {"refine": Full().blueprint(), "refine_branch": "reach", "uncertainty_head": foresees}
    reaching: Any = rebuild(built | {"init_args": built["init_args"] | changed})
    reaching.load_state_dict(policy.state_dict(), strict=False)
    for part in reaching.branch.head.parameters():
        torch.nn.init.zeros_(part)  # the former refinement's
    copied: ACT = reaching.eval()
    return copied


def fit_reach(policy: ACT, data: ChunkDataModule, *, stride: int) -> None:
    """Teach a policy's `reach` on its training episodes, and nothing else of it.

    Args:
        policy: from `with_reach`.
        data: after `setup`, those of its training.
        stride: control steps between two chunks.

    Raises:
        ConfigError: the demonstrations are of other arms, or have no keyframes.
    """
    assert policy.reach is not None
    known = _known(policy, data, stride)
    policy.requires_grad_(False)
    policy.reach.requires_grad_(True)
    optimizer = torch.optim.AdamW(policy.reach.parameters(), RATE, weight_decay=DECAY)
    chance = torch.Generator().manual_seed(0)
    for step in range(STEPS):
        optimizer.param_groups[0]["lr"] = RATE * (1 - step / STEPS)
        rows = torch.randint(len(known.valid), (ROWS,), generator=chance)
        hidden, coarse, points, shown, valid = (part[rows] for part in known)
        optimizer.zero_grad()
        policy.reach.lesson(hidden.float(), coarse, points, shown, valid).backward()
        optimizer.step()


def _known(policy: ACT, data: ChunkDataModule, stride: int) -> Known:
    parts: list[Known] = []
    given: dict[str, tuple[Tensor, ...]] = {}
    assert isinstance(policy.reach, Reach)
    hook = policy.reach.register_forward_pre_hook(lambda _, inputs: given.update(inputs=inputs))
    for batch in batches(data, data.episode_split.train, stride=stride):
        if batch.keyframes is None:
            fix = "Give the folder with the recording that the policy was trained on, with --data."
            raise ConfigError("demonstrations", "keyframes", "none", fix)
        if not parts:
            require_arms(batch)
        policy.predict(batch.observation)
        hidden, coarse, points = given["inputs"]
        parts.append(Known(hidden.half(), coarse, points, batch.actions, batch.valid))
    hook.remove()
    return Known(*(torch.cat(column) for column in zip(*parts, strict=True)))

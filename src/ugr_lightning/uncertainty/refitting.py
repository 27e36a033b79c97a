"""A refinement for a policy that is trained; what the policy was taught stays as it is."""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from ugr_lightning.blueprint import rebuild
from ugr_lightning.data.datamodule import ChunkDataModule
from ugr_lightning.errors import ConfigError
from ugr_lightning.models.act import ACT
from ugr_lightning.models.losses import refine_loss
from ugr_lightning.models.refine.selector import Selector
from ugr_lightning.uncertainty.predictions import batches

STEPS, ROWS, RATE, DECAY = 1500, 32, 1e-3, 1e-2


class Known(NamedTuple):
    """What n coarse chunks were made of, and what was demonstrated.

    Args:
        hidden: (n, K, D) float16.
        coarse: (n, K, A) normalised.
        log_variance: (n, K); NaN without an uncertainty head.
        target: (n, K, A) demonstrated, normalised.
        valid: (n, K) bool.
    """

    hidden: Tensor
    coarse: Tensor
    log_variance: Tensor
    target: Tensor
    valid: Tensor


def with_refinement(policy: ACT, refine: Selector) -> ACT:
    """A copy of a policy with another refinement in place of what it has; it has learned nothing yet.

    Args:
        policy: a trained one.
        refine: which steps are to be refined.

    Raises:
        ConfigError: the policy lacks what the refinement needs.
    """
    foresees = policy.uncertainty_head is not None
    if refine.needs_uncertainty and not foresees:
        fix = "Choose other steps, or train one that foresees them, e.g. `--config uncert`."
        raise ConfigError(f"refine: {type(refine).__name__}", "a policy with an uncertainty head", "none", fix)
    built = policy.blueprint()
    changed = {"refine": refine.blueprint(), "uncertainty_head": foresees}
    unrefined = {k: v for k, v in policy.state_dict().items() if not k.startswith("branch.")}
    refining: Any = rebuild(built | {"init_args": built["init_args"] | changed})
    refining.load_state_dict(unrefined, strict=False)
    copied: ACT = refining.eval()
    return copied


def fit_refinement(policy: ACT, data: ChunkDataModule, *, stride: int) -> None:
    """Teach a policy's refinement on its training episodes, and nothing else of it.

    Args:
        policy: from `with_refinement`.
        data: after `setup`, those of its training.
        stride: control steps between two chunks.
    """
    assert policy.branch is not None
    known = _known(policy, data, stride)
    optimizer = torch.optim.AdamW(policy.branch.parameters(), RATE, weight_decay=DECAY)
    chance = torch.Generator().manual_seed(0)
    policy.train()
    for step in range(STEPS):
        optimizer.param_groups[0]["lr"] = RATE * (1 - step / STEPS)
        rows = torch.randint(len(known.valid), (ROWS,), generator=chance)
        optimizer.zero_grad()
        _lesson(policy, Known(*(part[rows] for part in known))).backward()
        optimizer.step()
    policy.eval()


def _lesson(policy: ACT, known: Known) -> Tensor:
    doubt = None if policy.uncertainty_head is None else known.log_variance
    actions, chosen = policy.refined(known.hidden.float(), known.coarse, doubt, known.valid)
    assert chosen is not None
    return refine_loss(actions, known.target, chosen, known.valid, policy.reconstruction)


def _known(policy: ACT, data: ChunkDataModule, stride: int) -> Known:
    parts: list[Known] = []
    given: dict[str, Tensor] = {}
    hook = policy.action_head.register_forward_hook(
        lambda _, inputs, coarse: given.update(hidden=inputs[0], coarse=coarse)
    )
    every = policy.uncertainty_holdout  # of these episodes the actions teach the uncertainty only
    episodes = tuple(episode for episode in data.episode_split.train if not every or episode % every)
    for batch in batches(data, episodes, stride=stride):
        doubt = policy.predict(batch.observation).log_variance
        if doubt is None:
            doubt = torch.full(batch.valid.shape, torch.nan)
        target = policy.normalizer.action(batch.actions)
        parts.append(Known(given["hidden"].half(), given["coarse"], doubt, target, batch.valid))
    hook.remove()
    return Known(*(torch.cat(column) for column in zip(*parts, strict=True)))

"""Whether and how a training goes on from a checkpoint when the config or the demonstrations are no longer the same."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from torch import Tensor
from torch.optim.lr_scheduler import LambdaLR

from ugr_lightning.contract import ChunkPolicy, Statistics
from ugr_lightning.errors import CheckpointError
from ugr_lightning.models.checkpoint import describe
from ugr_lightning.training.optimizer import Parts

HONOURED = (
    *("seed_everything", "model.", "average.", "checkpoints.", "data.batch_size", "data.sampling."),
    *("trainer.gradient_clip", "trainer.accumulate_grad_batches", "trainer.precision"),
)
"""Keys that decide what is learned and may change on the way; they are kept in the checkpoint to say what changed."""
_PREFIX = "policy."
_ENTRY = "trained_with"


def check_weights(path: Path, content: dict[str, Any], policy: ChunkPolicy) -> None:
    """Make sure that a policy can take up the weights of a checkpoint.

    Args:
        path: of the checkpoint.
        content: what it holds.
        policy: as the config builds it.

    Raises:
        CheckpointError: weights of another size or structure; names the first.
    """
    weights = {k.removeprefix(_PREFIX): v for k, v in content.get("state_dict", {}).items() if k.startswith(_PREFIX)}
    before = {name: tuple(value.shape) for name, value in weights.items()}
    now = {name: tuple(value.shape) for name, value in policy.state_dict().items()}
    if before != now:
        names = [name for name in {**before, **now} if before.get(name) != now.get(name)]
        expected, got = (f"{names[0]} {shapes.get(names[0], 'absent')}" for shapes in (now, before))
        fix = "Use the config of the run that wrote it (config.yaml beside it), or train afresh without --checkpoint."
        if len(names) > 1:
            got += f" ({len(names)} tensors differ)"
        raise CheckpointError(path, f"the weights of the policy in the config, {expected}", got, fix)


def check_training(path: Path, content: dict[str, Any], parts: Parts) -> None:
    """Make sure that a checkpoint holds a training of such a policy and not only weights.

    Args:
        path: of the checkpoint.
        content: what it holds.
        parts: what is trained of the policy.

    Raises:
        CheckpointError: it was imported or exported, or its optimiser divides the parameters in another way.
    """
    missing = [name for name in ("optimizer_states", "lr_schedulers", "loops") if name not in content]
    if missing:
        fix = "It can be rolled out, exported and scored; a training goes on from a checkpoint of `ugr fit` only."
        raise CheckpointError(path, "the state of a training", f"weights only (no {', '.join(missing)})", fix)
    groups = [group for state in content["optimizer_states"] for group in state["param_groups"]]
    rate = next((group["initial_lr"] for group in groups if "ns_steps" in group), "null")  # AdamW has no such setting
    if (rate == "null") == bool(parts.mixing):
        expected, got = ("with Muon", "without") if parts.mixing else ("without Muon", "with it")
        fix = f"Set `model.muon_learning_rate` to {rate}, or train afresh without --checkpoint."
        raise CheckpointError(path, f"a training {expected}", f"one {got}", fix)
    before = [len(group["params"]) for group in groups]
    now = [len(part) for part in parts if part]
    if before != now:
        fix = "It is of another version of this package: go on with that one, or train afresh without --checkpoint."
        if sum(before) != sum(now):
            fix = "Other parameters are frozen now: let the same ones learn, or train afresh without --checkpoint."
        raise CheckpointError(path, f"an optimiser of {_counts(now)} parameters", _counts(before), fix)


def check_data(path: Path, content: dict[str, Any], policy: ChunkPolicy, data: Any) -> None:
    """Make sure that a training goes on with what it has been trained on.

    Args:
        path: of the checkpoint.
        content: what it holds.
        policy: as the config builds it.
        data: the data module, set up.

    Raises:
        CheckpointError: other episodes, another division of them, or pictures and numbers of another meaning; names it.
    """
    before, now = content.get("policy", {}), describe(policy, data)
    pairs = {"cameras": (before.get("cameras"), now["cameras"])}
    pairs |= {f"data.{name}": (value, now["data"].get(name)) for name, value in before.get("data", {}).items()}
    changed = {key: pair for key, pair in pairs.items() if pair[0] is not None and pair[0] != pair[1]}
    mixed = "data.split" in changed
    if not mixed:
        changed.pop("data.episodes", None)  # said in another way: they are the same
    kept = content.get(_ENTRY, {}).get("statistics")
    if not changed and kept is not None and not _same(kept, data.statistics):
        changed["the episodes"] = ("those of the checkpoint", "others with the same names (their joints differ)")
        mixed = True
    if changed:
        expected, got = ("; ".join(f"{key} {_short(pair[side])}" for key, pair in changed.items()) for side in (0, 1))
        why = "what was validated before would be trained on" if mixed else "its weights know no other"
        fix = f"Restore it, or train afresh without --checkpoint: {why}."
        raise CheckpointError(path, f"what it was trained on ({expected})", got, fix)


def changes(content: dict[str, Any], config: Mapping[str, Any]) -> list[str]:
    """What of `HONOURED` is no longer as it was, in words.

    Args:
        content: of the checkpoint.
        config: values by dotted key.
    """
    before = content.get(_ENTRY, {}).get("config", {})
    now = _honoured(config)
    return [f"{key} {before[key]} -> {now.get(key)}" for key in before if now.get(key) != before[key]]


class TrainedWith(Callback):
    """Keeps what a later start is compared with in each checkpoint, and lets the config's optimiser settings hold.

    Lightning restores learning rates, weight decay and betas from the checkpoint, over those of the config.

    Args:
        config: values by dotted key.

    Source: docs/resume.md.
    """

    def __init__(self, config: Mapping[str, Any]) -> None:
        self._config = _honoured(config)
        self._groups: list[list[dict[str, Any]]] = []

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Remember the optimiser as the config builds it, before a checkpoint is restored."""
        self._groups = [
            [{key: value for key, value in group.items() if key != "params"} for group in optimizer.param_groups]
            for optimizer in trainer.optimizers
        ]

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Let the config's settings hold, at the place in the schedule that the training has reached."""
        for optimizer, groups in zip(trainer.optimizers, self._groups, strict=True):
            for group, configured in zip(optimizer.param_groups, groups, strict=True):
                group.update(configured)
        for scheduler in (found.scheduler for found in trainer.lr_scheduler_configs):
            if isinstance(scheduler, LambdaLR):
                scheduler.base_lrs = [group["initial_lr"] for group in scheduler.optimizer.param_groups]
                for group, factor in zip(scheduler.optimizer.param_groups, scheduler.lr_lambdas, strict=True):
                    group["lr"] = group["initial_lr"] * factor(scheduler.last_epoch)

    def on_save_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """Keep the settings and the statistics of the training episodes."""
        statistics = trainer.datamodule.statistics  # type: ignore[attr-defined]
        checkpoint[_ENTRY] = {"config": self._config, "statistics": {k: v.clone() for k, v in _tensors(statistics)}}


def _honoured(config: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in config.items() if key.startswith(HONOURED)}


def _tensors(statistics: Statistics) -> list[tuple[str, Tensor]]:
    return [(name, value) for name, value in statistics._asdict().items() if isinstance(value, Tensor)]


def _same(kept: dict[str, Tensor], statistics: Statistics) -> bool:
    """Whether statistics agree but for the order in which a machine sums."""
    return all(
        name not in kept or (kept[name].shape == value.shape and torch.allclose(kept[name], value, 1e-4, 1e-5))
        for name, value in _tensors(statistics)
    )


def _counts(sizes: list[int]) -> str:
    return " and ".join(map(str, sizes))


def _short(value: Any) -> str:
    text = str(value)
    return text if len(text) <= 160 else f"{text[:120]} ... {text[-30:]}"

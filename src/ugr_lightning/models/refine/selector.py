"""What decides which steps of a chunk are refined: the mask m of A_1 = A_0 + m * dA."""

from abc import ABC, abstractmethod
from typing import ClassVar

import torch
from torch import Tensor

from ugr_lightning.blueprint import Blueprinted
from ugr_lightning.errors import ConfigError, UGRError
from ugr_lightning.system.workers import describe_error


class Selector(Blueprinted, ABC):
    """The rule by which a refinement strategy chooses steps. A new strategy is one file with one subclass.

    A selector has no parameters of its own to train; it is part of the policy's blueprint, not of its state.

    Source: paper, Eq. (3).
    """

    needs_uncertainty: ClassVar[bool] = False
    """Whether the policy must predict a log-variance per step for this rule."""

    @abstractmethod
    def budget(self, chunk_length: int) -> int | None:
        """How many steps of a whole chunk are refined at run time, M; None if that depends on the input.

        Args:
            chunk_length: K.

        Raises:
            ConfigError: the rule cannot work with chunks of that length.
        """

    @abstractmethod
    def select(self, log_variance: Tensor | None, valid: Tensor, training: bool) -> Tensor:
        """Choose the steps.

        Args:
            log_variance: (B, K) float32 without gradient, or None where the policy has no uncertainty head.
            valid: (B, K) bool, False on padded steps, which are never chosen. All True at run time.
            training: whether randomness is allowed.

        Returns:
            (B, K) bool.
        """


def checked_budget(selector: Selector, chunk_length: int, uncertain: bool) -> int | None:
    """The budget of a selector that has been tried on made-up chunks: two whole ones, then one that ends early.

    Args:
        selector: the rule.
        chunk_length: K.
        uncertain: whether the policy predicts a log-variance.

    Raises:
        ConfigError: it does not keep what `Selector` says of `budget` and `select`; says what it did.
    """
    name, budget = type(selector).__name__, selector.budget(chunk_length)
    if budget is not None and not (isinstance(budget, int) and 0 <= budget <= chunk_length):
        expected = f"a whole number of steps up to {chunk_length}, or None"
        raise ConfigError(f"{name}.budget", expected, repr(budget), "Correct what it returns.")
    with torch.random.fork_rng(devices=[]), torch.device("cpu"):
        whole = torch.ones(2, chunk_length, dtype=torch.bool)
        padded = torch.arange(chunk_length) < torch.tensor([[chunk_length], [(chunk_length + 1) // 2]])  # (2, K)
        chosen, again = (_mask(selector, whole, False, uncertain) for _ in range(2))
        beyond = int((_mask(selector, padded, True, uncertain) & ~padded).sum())
    where, counts = f"{name}.select", sorted(set(chosen.sum(1).tolist()))
    if budget is not None and counts != [budget]:
        fix = "Correct one of them; `budget` returns None where the number depends on the input."
        got = " and ".join(map(str, counts))
        raise ConfigError(where, f"{budget} chosen steps in every chunk, as `budget` promises", got, fix)
    if not torch.equal(chosen, again):
        fix = "Use chance only where `training` is true."
        raise ConfigError(where, "the same choice whenever it is asked at run time", "another one", fix)
    if beyond:
        raise ConfigError(where, "no padded step chosen", f"{beyond} of them", "Let it return `mask & valid`.")
    return budget


def _mask(selector: Selector, valid: Tensor, training: bool, uncertain: bool) -> Tensor:
    """What a selector chooses (B, K) of steps (B, K), given a log-variance of noise or none."""
    where, expected = f"{type(selector).__name__}.select", f"bool {tuple(valid.shape)}, a mask (B, K)"
    noise = torch.randn(valid.shape, generator=torch.Generator().manual_seed(0))
    try:
        mask: object = selector.select(noise if uncertain else None, valid.clone(), training)
    except UGRError:
        raise
    except Exception as error:  # whatever a user's rule raises
        fix = "Correct the rule."
        if not uncertain:
            fix += " It gets no log-variance unless its class says `needs_uncertainty = True`."
        raise ConfigError(where, expected, describe_error(error), fix) from error
    if not isinstance(mask, Tensor) or mask.dtype != torch.bool or mask.shape != valid.shape:
        got = f"{mask.dtype} {tuple(mask.shape)}".removeprefix("torch.") if isinstance(mask, Tensor) else repr(mask)
        fix = "Return a truth value for each step of each sample: compare, and expand to `valid.shape`."
        raise ConfigError(where, expected, got, fix)
    return mask

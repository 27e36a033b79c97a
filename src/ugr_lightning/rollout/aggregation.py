"""How a stream of overlapping action chunks becomes one action per control step."""

from abc import ABC, abstractmethod

import numpy as np

from ugr_lightning.embodiment import ACTION_DIM
from ugr_lightning.errors import ConfigError

AGGREGATE = "aggregate"
AGGREGATE_VARIANCE = "aggregate-variance"


class Execution(ABC):
    """Turns chunks into actions for several environment slots that run independently of each other.

    Per control step and slot: ask `needs_query`; if so predict a chunk and `push` it; then take `next`.
    """

    name: str

    @abstractmethod
    def reset(self, slot: int) -> None:
        """Forget everything about a slot, at the start of an episode."""

    @abstractmethod
    def needs_query(self, slot: int) -> bool:
        """Whether the slot wants a new chunk before its next action."""

    def steps_left(self, slot: int) -> int:
        """How many actions of the slot are known before it wants a new chunk."""
        return 0

    @abstractmethod
    def push(self, slot: int, chunk: np.ndarray, log_variance: np.ndarray | None = None) -> None:
        """Give a slot the chunk (K, A), and s_k (K,) if there is one, that was predicted at its current step."""

    @abstractmethod
    def next(self, slot: int) -> np.ndarray:
        """The action (A,) float32 of the slot's current step; moves the slot on by one step."""


class TemporalAggregation(Execution):
    """Average of all predictions that were made for a step, weighted exp(-decay i), i = 0 for the oldest.

    With `by_variance`, the weight of a prediction is also exp(-s), the inverse of the variance predicted for it.

    Kept online as K running sums per slot: a prediction that arrives later always has a larger i, so the weights of
    the earlier ones never change. Needs O(K A) memory where the table of the public codes needs O(T (T + K) A).

    Args:
        chunk_length: K.
        action_dim: A.
        decay: weight decay per prediction; positive means that older predictions count more.
        slots: number of environment slots.
        by_variance: trust a prediction less the more uncertain it is.

    Source: tonyzhaozh/act@742c753, imitate_episodes.py (weights, oldest first); paper, section IV-A.
    """

    def __init__(
        self,
        chunk_length: int,
        action_dim: int = ACTION_DIM,
        decay: float = 0.01,
        slots: int = 1,
        by_variance: bool = False,
    ) -> None:
        self.name = AGGREGATE_VARIANCE if by_variance else AGGREGATE
        self._decay, self._by_variance = decay, by_variance
        self._sums = np.zeros((slots, chunk_length, action_dim))  # float64: sums of up to K terms
        self._weights = np.zeros((slots, chunk_length))
        self._counts = np.zeros((slots, chunk_length))

    def reset(self, slot: int) -> None:
        for table in (self._sums, self._weights, self._counts):
            table[slot] = 0.0

    def needs_query(self, slot: int) -> bool:
        return True

    def push(self, slot: int, chunk: np.ndarray, log_variance: np.ndarray | None = None) -> None:
        """Add a chunk (K, A) that starts at the slot's current step, with s_k (K,) where weights depend on it.

        Raises:
            ConfigError: a chunk of another shape; or weights by variance for a policy that predicts none.
        """
        if chunk.shape != self._sums.shape[1:]:
            raise ConfigError("chunk", self._sums.shape[1:], chunk.shape, "Build the aggregation for this policy.")
        weights = np.exp(-self._decay * self._counts[slot])  # (K,)
        if self._by_variance:
            if log_variance is None:
                fix = f"Execute this policy with `{AGGREGATE}` or a number of steps."
                raise ConfigError(f"execution {self.name}", "a policy with a log-variance per step", "none", fix)
            weights = weights * np.exp(-log_variance.astype(np.float64))  # (K,)
        self._sums[slot] += weights[:, None] * chunk  # (K, A)
        self._weights[slot] += weights
        self._counts[slot] += 1

    def next(self, slot: int) -> np.ndarray:
        if self._counts[slot, 0] == 0:
            raise RuntimeError(f"slot {slot} has no prediction for its current step: push a chunk first")
        action = self._sums[slot, 0] / self._weights[slot, 0]  # (A,)
        for table in (self._sums, self._weights, self._counts):
            table[slot, :-1] = table[slot, 1:]
            table[slot, -1] = 0.0
        return action.astype(np.float32)


class ChunkExecution(Execution):
    """Executes the first steps of each chunk as they are, then asks for a new one.

    Args:
        steps: how many steps of each chunk are executed, at most K.
        slots: number of environment slots.
    """

    def __init__(self, steps: int, slots: int = 1) -> None:
        self.name = str(steps)
        self._steps = steps
        self._chunks: list[np.ndarray | None] = [None] * slots
        self._cursors = [0] * slots

    def reset(self, slot: int) -> None:
        self._chunks[slot] = None

    def needs_query(self, slot: int) -> bool:
        return self.steps_left(slot) == 0

    def steps_left(self, slot: int) -> int:
        return 0 if self._chunks[slot] is None else self._steps - self._cursors[slot]

    def push(self, slot: int, chunk: np.ndarray, log_variance: np.ndarray | None = None) -> None:
        self._chunks[slot], self._cursors[slot] = np.array(chunk, np.float32), 0

    def next(self, slot: int) -> np.ndarray:
        chunk = self._chunks[slot]
        if chunk is None or self.needs_query(slot):
            raise RuntimeError(f"slot {slot} has used up its chunk: push a new one first")
        self._cursors[slot] += 1
        return chunk[self._cursors[slot] - 1]


def make_execution(execution: str | int, chunk_length: int, action_dim: int = ACTION_DIM, slots: int = 1) -> Execution:
    """Build what the setting `execution` names.

    Args:
        execution: `aggregate`, `aggregate-variance`, or the number of steps (1 .. K) executed of a chunk.
        chunk_length: K of the policy.
        action_dim: A of the policy.
        slots: number of environment slots.

    Raises:
        ConfigError: none of the three.
    """
    if execution in (AGGREGATE, AGGREGATE_VARIANCE):
        return TemporalAggregation(chunk_length, action_dim, slots=slots, by_variance=execution == AGGREGATE_VARIANCE)
    text = str(execution).strip()
    if not text.isdigit() or not 1 <= int(text) <= chunk_length:
        expected = f"`{AGGREGATE}`, `{AGGREGATE_VARIANCE}` or a number of steps from 1 to {chunk_length}"
        raise ConfigError("execution", expected, execution, "Say how the chunks are to be executed.")
    return ChunkExecution(int(text), slots)

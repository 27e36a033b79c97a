"""What a policy would have commanded along demonstrations, beside what was commanded: no simulator, no robot.

The first thing to look at with data of one's own. A policy that is wrong where it was trained was given pictures,
joints or times that do not belong together; one that is right there and wrong elsewhere needs more demonstrations.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch

from ugr_lightning.contract import ChunkPolicy
from ugr_lightning.data.datamodule import ChunkDataModule
from ugr_lightning.results.tables import Cells
from ugr_lightning.uncertainty.predictions import batches

BADLY_FITTED = 0.5
"""Share of the error of standing still above which training episodes do not count as fitted."""
BY_HEART = 3.0
"""How many times its error on training episodes a policy may make on others and not be told that it has learned them
by heart."""


class Followed(NamedTuple):
    """Predicted and demonstrated commands of n chunks, robot units.

    Args:
        predicted: (n, K, A).
        demonstrated: (n, K, A).
        valid: (n, K) bool, False on padded steps.
        still: (n, A) the command that would keep the arms where they are; None where states are no commands.
        episode: (n,) position of the episode in the data.
        step: (n,) time step of the query.
    """

    predicted: np.ndarray
    demonstrated: np.ndarray
    valid: np.ndarray
    still: np.ndarray | None
    episode: np.ndarray
    step: np.ndarray

    def joint_error(self) -> np.ndarray:
        """Mean absolute error of each command, (A,) robot units."""
        return _mean(np.abs(self.predicted - self.demonstrated), self.valid)

    def still_error(self) -> np.ndarray | None:
        """The same for standing still."""
        return None if self.still is None else _mean(np.abs(self.still[:, None] - self.demonstrated), self.valid)


class Errors(NamedTuple):
    """Mean absolute errors of commands, (A,) each, robot units.

    Args:
        training: on training episodes.
        validation: on the others.
        still: of standing still, on the others; None where states are no commands.
        std: (A,) standard deviation of the training commands.
    """

    training: np.ndarray
    validation: np.ndarray
    still: np.ndarray | None
    std: np.ndarray

    def overall(self) -> tuple[float, float, float | None]:
        """Means over all commands, in their standard deviations, in the order of the fields."""
        training, validation = (float((part / self.std).mean()) for part in (self.training, self.validation))
        return training, validation, None if self.still is None else float((self.still / self.std).mean())


def follow(policy: ChunkPolicy, data: ChunkDataModule, episodes: tuple[int, ...], *, stride: int) -> Followed:
    """Query a policy on every `stride`-th step of some episodes.

    Args:
        policy: in evaluation mode.
        data: after `setup`.
        episodes: positions of the episodes.
        stride: control steps between two queries.
    """
    parts: list[list[np.ndarray]] = []
    for batch in batches(data, episodes, stride=stride):
        with torch.no_grad():
            chunk = policy.predict(batch.observation)
        state = batch.state if batch.state.dim() == 2 else batch.state[:, -1]  # (B, S), now
        found = (chunk.actions.float(), batch.actions, batch.valid, state, batch.episode, batch.step)
        parts.append([tensor.numpy() for tensor in found])
    predicted, demonstrated, valid, still, episode, step = (np.concatenate(part) for part in zip(*parts, strict=True))
    commands = still.shape[-1] == predicted.shape[-1]
    return Followed(predicted, demonstrated, valid, still if commands else None, episode, step)


def compare_parts(training: Followed, validation: Followed, std: np.ndarray) -> Errors:
    """Errors on training and on validation episodes.

    Args:
        training, validation: what a policy said along them.
        std: (A,) standard deviation of the training commands.
    """
    return Errors(training.joint_error(), validation.joint_error(), validation.still_error(), std)


def error_table(errors: Errors, names: Sequence[str]) -> Cells:
    """Errors by command, heading first, and their mean in standard deviations last.

    Args:
        errors: of A commands.
        names: of the commands, as the demonstrations have them.
    """
    still = () if errors.still is None else ("standing still",)
    head = ("command, in its own unit", "training", "validation", *still, "deviation")
    columns = [column for column in errors if column is not None]
    rows = zip(map(_called, names), *columns, strict=True)
    total = [f"{value:.3f}" for value in errors.overall() if value is not None]
    table: Cells = [head, *((name, *(f"{value:.4f}" for value in values)) for name, *values in rows)]
    return [*table, ("mean, in deviations", *total, "1")]


def conclusion(errors: Errors, episodes: tuple[int, int]) -> str:
    """What the errors say, in words.

    Args:
        errors: by command.
        episodes: how many were followed in training and in validation.
    """
    training, validation, still = errors.overall()
    says = (
        f"On {episodes[0]} training episodes the commands are off by {training:.3f} standard deviations on average, on "
        f"{episodes[1]} validation episodes by {validation:.3f}"
    )
    says += "." if still is None else f"; standing still would be off by {still:.3f} there."
    if still is not None and training > BADLY_FITTED * still:
        return (
            f"{says} That does not fit the demonstrations it was trained on: train longer, or look for pictures, "
            "joints or an alignment that do not belong together (`ugr data inspect`)."
        )
    if validation > BY_HEART * training:
        return f"{says} It knows its demonstrations by heart: more of them are likely to help, longer training is not."
    return f"{says} It fits what it was trained on, and what it was not trained on not much worse."


def episode_figure(followed: Followed, data: ChunkDataModule, episode: int, title: str) -> Any:
    """The commands of a whole demonstration, and the chunks that were predicted along it.

    Args:
        followed: with queries in this episode.
        data: after `setup`.
        episode: its position in the data.
        title: of the figure.
    """
    from matplotlib.figure import Figure

    done = data.demonstrations[episode].action  # (T, A)
    rows = np.flatnonzero(followed.episode == episode)
    names, std = list(map(_called, data.command_names)), data.statistics.action_std.numpy()
    columns = (len(names) + 1) // 2
    figure = Figure(figsize=(2.4 * columns, 5), layout="constrained")
    axes = figure.subplots(2, columns, squeeze=False, sharex=True)
    for dim, axis in enumerate(axes.flat[: len(names)]):
        for row in rows:
            length = int(followed.valid[row].sum())
            time = followed.step[row] + np.arange(length)
            label = "predicted" if row == rows[0] else None
            axis.plot(time, followed.predicted[row, :length, dim], color="tab:orange", lw=0.7, alpha=0.6, label=label)
        axis.plot(done[:, dim], color="black", lw=1, label="demonstrated")
        axis.set_title(names[dim], fontsize=8)
        axis.tick_params(labelsize=7)
        axis.set_xlim(0, len(done))
        low, high = axis.get_ylim()
        if high - low < std[dim]:  # an arm at rest shall look like one
            axis.set_ylim((low + high - std[dim]) / 2, (low + high + std[dim]) / 2)
    axes.flat[0].legend(fontsize=7)
    figure.suptitle(title, fontsize=9)
    return figure


def _called(name: str) -> str:
    """A column of a file that does not name it, by its position; others by their name."""
    return f"command {name}" if name.isdigit() else name.replace("_", " ")


def _mean(values: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Mean of (n, K, A) over the valid steps (n, K), (A,) float64."""
    mean: np.ndarray = values[valid].mean(0, dtype=np.float64)
    return mean

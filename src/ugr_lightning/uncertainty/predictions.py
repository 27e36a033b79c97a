"""What a trained policy predicts on the demonstrations it was, and was not, trained on."""

import copy
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from ugr_lightning.contract import Batch, ChunkPolicy
from ugr_lightning.data.chunks import AfterEnd
from ugr_lightning.data.datamodule import ChunkDataModule
from ugr_lightning.data.layout import Layout
from ugr_lightning.data.statistics import compute_statistics
from ugr_lightning.errors import DataError
from ugr_lightning.models.checkpoint import TrainingData

AT_ONCE = 16


class Predictions(NamedTuple):
    """Errors, as lengths over all joints, and uncertainties of n chunks; NaN on padded steps.

    The unit is the standard deviation of the training actions.

    Args:
        coarse: (n, K) length of the error of the coarse action, the one that the uncertainty head learns.
        executed: (n, K) the same of the executed action.
        log_variance: (n, K) s_k; None where the policy has none.
        refined: (n, K) bool; None where the policy does not refine.
        episode: (n,) position of the episode in the data.
        step: (n,) time step of the observation.
        missed: (n, 2) metres between where the next keyframe of each arm was seen and where it was shown; None where
            the policy does not look for them.
        keyframe: (n, 2) time step of that keyframe; None likewise.
    """

    coarse: np.ndarray
    executed: np.ndarray
    log_variance: np.ndarray | None
    refined: np.ndarray | None
    episode: np.ndarray
    step: np.ndarray
    missed: np.ndarray | None = None
    keyframe: np.ndarray | None = None


def predict(policy: ChunkPolicy, data: ChunkDataModule, episodes: tuple[int, ...], *, stride: int = 5) -> Predictions:
    """Query a policy on every `stride`-th step of some episodes.

    Args:
        policy: in evaluation mode.
        data: after `setup`.
        episodes: positions of the episodes.
        stride: control steps between two queries.

    Returns:
        Predictions in the order of episode and step.
    """
    std = data.statistics.action_std  # (A,)
    parts: list[Predictions] = []
    for batch in batches(data, episodes, stride=stride):
        with torch.no_grad():
            chunk = policy.predict(batch.observation)

        def error(actions: torch.Tensor, batch: Any = batch) -> np.ndarray:
            length = ((actions.float() - batch.actions) / std).norm(dim=-1)  # (B, K)
            return length.masked_fill(~batch.valid, torch.nan).double().numpy()

        missed = keyframe = None
        if chunk.points is not None and batch.keyframes is not None:
            seen = chunk.points[:, :, 0]  # (B, 2, 3), the tools; behind them, their feet on the table
            missed = (seen - batch.keyframes.position).norm(dim=-1).double().numpy()  # (B, 2)
            keyframe = (batch.step[:, None] + batch.keyframes.delay).numpy()  # (B, 2)
        parts.append(
            Predictions(
                coarse=error(chunk.actions if chunk.coarse is None else chunk.coarse),
                executed=error(chunk.actions),
                log_variance=None if chunk.log_variance is None else chunk.log_variance.double().numpy(),
                refined=None if chunk.refined is None else chunk.refined.numpy(),
                episode=batch.episode.numpy(),
                step=batch.step.numpy(),
                missed=missed,
                keyframe=keyframe,
            )
        )
    whole: list[Any] = [None if of[0] is None else np.concatenate(of) for of in zip(*parts, strict=True)]
    return Predictions(*whole)


def batches(data: ChunkDataModule, episodes: tuple[int, ...], *, stride: int) -> Iterator[Batch]:
    """What was seen and done at every `stride`-th step of some episodes, in order.

    Args:
        data: after `setup`.
        episodes: positions of the episodes.
        stride: control steps between two samples.
    """
    frames = data.data.frames.of(episodes, stride)
    for start in range(0, len(frames), AT_ONCE):
        yield data.data.__getitems__(frames[start : start + AT_ONCE].tolist())


def open_data(
    policy: ChunkPolicy, trained: TrainingData, root: str, after_end: AfterEnd | None = None, named_by: str = ""
) -> ChunkDataModule:
    """The demonstrations a checkpoint was trained on, with its own split.

    Args:
        policy: from the checkpoint.
        trained: what the checkpoint says about its data.
        root: folder of recordings, `data.root` of the training, or the task's own in it; where the training had a
            `data.folder`, that one.
        after_end: `mask` or `hold` in place of the checkpoint's own.
        named_by: what says that they are there, for the error, where that is not who calls.

    Raises:
        DataError: the recording is not there, or its episodes are others than those of the checkpoint.
    """
    size, given = trained.get("image_size"), trained["episodes"]
    own = Path(root).resolve().parts[-2:] == (trained["task"], trained["setting"])
    data = ChunkDataModule(
        task=trained["task"],
        root=root,
        setting=trained["setting"],
        episodes=given if isinstance(given, int) else tuple(given),
        tasks=tuple(trained.get("tasks", ())),
        cameras=policy.cameras,
        image_size=None if size is None else (int(size[0]), int(size[1])),
        chunk_length=policy.chunk_length,
        cache="none",
        observation_steps=policy.observation_steps,
        split_seed=trained["split_seed"],
        state=trained.get("state", "commanded"),
        action_offset=trained.get("action_offset", 0),
        after_end=after_end or trained.get("after_end", "mask"),
        folder=root if own or trained.get("elsewhere") else None,
        layout=Layout.of_training(trained),
    )
    if not data.folder.exists():
        expected = "the demonstrations of the checkpoint" + f", as {named_by} says" * bool(named_by)
        raise DataError(data.folder, expected, "nothing there", "Say where they are: `--data FOLDER`.")
    data.setup()
    if data.split != trained["split"] or not _trained_with(policy, data):
        fix = "Give the folder with the recording that the policy was trained on, with --data."
        raise DataError(data.folder, "the episodes of the checkpoint's split", "others", fix)
    return data


def _trained_with(policy: ChunkPolicy, data: ChunkDataModule) -> bool:
    """Whether a policy has the statistics of the data; other tasks have episodes of the same names and seeds."""
    kept = policy.state_dict()
    everything = compute_statistics(data.demonstrations, state=data.state)  # `normalise_over: all`
    for statistics in (data.statistics, everything):
        told = copy.deepcopy(policy)
        told.set_statistics(statistics)
        pairs = [(kept[name], value) for name, value in told.state_dict().items()]
        if all(torch.allclose(one, other, 1e-4, 1e-5, equal_nan=True) for one, other in pairs):
            return True
    return False

"""A demonstration or a rollout as a timeline for the rerun viewer: what was seen, done and predicted, step by step."""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from ugr_lightning.contract import ChunkPolicy
from ugr_lightning.data.chunks import ChunkDataset
from ugr_lightning.data.episode import Episode
from ugr_lightning.data.storage.cache import open_frames
from ugr_lightning.errors import ConfigError, require_extra
from ugr_lightning.models.checkpoint import TrainingData
from ugr_lightning.rollout.traces import PredictionTrace
from ugr_lightning.system.files import publish

STEP = "control step"
LEADS = (0, 10, 25, 49)
"""How many steps before it was due a prediction is shown, beside what was commanded."""


class Plans(NamedTuple):
    """Chunks that a policy predicted along an episode.

    Args:
        query: (Q,) control steps at which they were predicted.
        chunks: (Q, K, A) robot units.
        log_variance: (Q, K) s_k; (Q, 0) for a policy without.
    """

    query: np.ndarray
    chunks: np.ndarray
    log_variance: np.ndarray


def predict_along(policy: ChunkPolicy, episode: Episode, data: TrainingData, stride: int, folder: Path) -> Plans:
    """Ask a policy at every `stride`-th step of a demonstration.

    Args:
        policy: ready to predict.
        episode: with the policy's cameras and joints.
        data: what the checkpoint says of its data: `image_size` and `state`.
        stride: control steps between two queries.
        folder: of the episode.

    Raises:
        ConfigError: the demonstration has other joints than the policy.
    """
    if (episode.state.shape[1], episode.action.shape[1]) != (policy.state_dim, policy.action_dim):
        expected = f"{policy.state_dim} joints and {policy.action_dim} commands, as the policy has"
        got = f"{episode.state.shape[1]} and {episode.action.shape[1]}"
        raise ConfigError(episode.path, expected, got, "Give demonstrations of the policy's robot.")
    size = data.get("image_size")
    store = open_frames([episode], "none", None if size is None else (int(size[0]), int(size[1])), folder)
    kind = data.get("state", "commanded")
    samples = ChunkDataset([episode], store, policy.chunk_length, kind, observation_steps=policy.observation_steps)
    query = np.arange(0, episode.length, stride)
    found = []
    with torch.no_grad():
        for step in query:
            found.append(policy.predict(samples[int(step)].observation))
    uncertainty = [() if one.log_variance is None else one.log_variance[0].numpy() for one in found]
    return Plans(query, np.stack([one.actions[0].numpy() for one in found]), np.array(uncertainty, np.float32))


def write_demonstration(path: Path, episode: Episode, joints: tuple[str, ...], plans: Plans | None = None) -> None:
    """Write a demonstration as an `.rrd` file, complete or not at all.

    Args:
        path: the file.
        episode: what is shown: cameras, joints, commands, and whatever else it holds for every step.
        joints: a name for each column of its commands.
        plans: what a policy predicted along it.

    Raises:
        ConfigError: the extra `view` is not installed.
    """
    recording = _Recording(f"{episode.path.parent.name}/{episode.name}", episode.cameras)
    for step in range(episode.length):
        for camera, picture in zip(episode.cameras, episode.images(step), strict=True):
            recording.picture(camera, step, picture)
    steps = np.arange(episode.length)
    recording.series("joints/state", steps, episode.state, joints)
    if episode.measured is not None:
        recording.series("joints/measured", steps, episode.measured, joints)
    recording.series("joints/command", steps, episode.action, joints)
    for name, values in _of_each_step(episode):
        if values.dtype.kind in "OUS":
            recording.words(f"episode/{name}", values)
        else:
            recording.series(f"episode/{name}", steps, values.astype(float), ())
    if plans is not None:
        recording.plans(plans, joints, episode.length)
    episode.frames.close()
    recording.write(path)


def write_rollout(path: Path, trace: PredictionTrace, joints: tuple[str, ...]) -> None:
    """Write what a policy predicted in an episode that it drove, from the trace of `ugr rollout --traces`.

    Args:
        path: the `.rrd` file.
        trace: of the episode.
        joints: a name for each column of its commands.

    Raises:
        ConfigError: the extra `view` is not installed.
    """
    recording = _Recording(f"seed {trace.seed}, {'success' if trace.success else 'failure'}", ())
    recording.plans(Plans(trace.query, trace.chunks.astype(np.float32), trace.log_variance), joints, trace.steps)
    recording.series("episode/contacts", np.arange(len(trace.contacts)), trace.contacts.astype(float), ())
    recording.write(path)


def _of_each_step(episode: Episode) -> Iterator[tuple[str, np.ndarray]]:
    """Whatever else the episode has one number, or a few, or one word of for every step."""
    for name, values in episode.extras.items():
        array = np.asarray(values)
        if array.ndim in (1, 2) and len(array) >= episode.length and array.dtype.kind in "OUSbiuf":
            yield name, array[: episode.length]


class _Recording:
    """A rerun recording of one episode on the timeline of its control steps.

    Args:
        name: shown by the viewer.
        cameras: V names.
    """

    def __init__(self, name: str, cameras: tuple[str, ...]) -> None:
        require_extra("ugr view", "view", "rerun", "rerun.blueprint")
        import rerun
        import rerun.blueprint as views

        self.rerun = rerun
        self.stream = rerun.RecordingStream("ugr-lightning", recording_id=name)
        pictures = [views.Spatial2DView(origin=f"cameras/{camera}", name=camera) for camera in cameras]
        plots = [views.TimeSeriesView(origin=origin, name=origin) for origin in ("joints", "predicted", "episode")]
        bars = views.BarChartView(origin="uncertainty", name="s_k of the newest chunk")
        shown = [views.Horizontal(*pictures)] if pictures else []
        self.layout = views.Blueprint(views.Vertical(*shown, views.Tabs(*plots), bars), collapse_panels=True)

    def picture(self, camera: str, step: int, picture: np.ndarray) -> None:
        """One picture (H, W, 3) uint8 RGB."""
        self.stream.set_time(STEP, sequence=step)
        self.stream.log(f"cameras/{camera}", self.rerun.Image(picture).compress())

    def series(self, name: str, steps: np.ndarray, values: np.ndarray, columns: tuple[str, ...]) -> None:
        """Curves: (T,) or (T, n) values at (T,) steps."""
        values = values[:, None] if values.ndim == 1 else values  # (T, n)
        names = columns if len(columns) == values.shape[1] else [f"{name}[{i}]" for i in range(values.shape[1])]
        self.stream.log(name, self.rerun.SeriesLines(names=list(names)), static=True)
        times = [self.rerun.TimeColumn(STEP, sequence=steps)]
        self.stream.send_columns(name, indexes=times, columns=self.rerun.Scalars.columns(scalars=values))

    def words(self, name: str, values: np.ndarray) -> None:
        """A word at every step at which it changes."""
        for step, word in enumerate(values):
            if step == 0 or word != values[step - 1]:
                self.stream.set_time(STEP, sequence=step)
                self.stream.log(name, self.rerun.TextLog(word.decode() if isinstance(word, bytes) else str(word)))

    def plans(self, plans: Plans, joints: tuple[str, ...], length: int) -> None:
        """What was predicted for a step, some steps before it; and the uncertainty of the newest chunk."""
        for lead in (lead for lead in LEADS if lead < plans.chunks.shape[1]):
            due = plans.query + lead  # (Q,)
            inside = due < length
            self.series(f"predicted/{lead}_steps_before", due[inside], plans.chunks[inside, lead], joints)
        if plans.log_variance.size:
            self.series("episode/mean_s_k", plans.query, plans.log_variance.mean(1), ())
            for step, values in zip(plans.query, plans.log_variance, strict=True):
                self.stream.set_time(STEP, sequence=int(step))
                self.stream.log("uncertainty", self.rerun.BarChart(values))

    def write(self, path: Path) -> None:
        """Write the file, complete or not at all."""

        def save(partial: Path) -> None:
            self.stream.save(str(partial), default_blueprint=self.layout)
            self.stream.flush()
            self.stream.disconnect()

        publish(path, save)

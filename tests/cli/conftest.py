import deployed
import pytest
import torch
from PIL import Image
from recordings import record

from ugr_lightning.data.datamodule import ChunkDataModule
from ugr_lightning.models.checkpoint import describe, write_checkpoint
from ugr_lightning.models.refine.uncertainty import Uncertainty
from ugr_lightning.results.results import EpisodeResult, append_result

DEMONSTRATION = {"steps": 12, "longer": 0, "size": (8, 12)}


@pytest.fixture(scope="session")
def recording(tmp_path_factory):
    """Root of a recording of five made-up demonstrations."""
    root = tmp_path_factory.mktemp("data")
    record(root, **DEMONSTRATION)
    return root


@pytest.fixture
def ten_demonstrations(tmp_path):
    """Root of a recording of ten made-up demonstrations: two of them validate."""
    record(tmp_path / "ten", 10, **DEMONSTRATION)
    return tmp_path / "ten"


@pytest.fixture
def untrained(ten_demonstrations):
    """Writes `policy_best.ckpt` of a policy that was told the statistics of ten demonstrations and learned nothing."""

    def write(policy, folder, data=None):
        where = data or {"root": str(ten_demonstrations)}
        data = ChunkDataModule(**where, episodes=10, chunk_length=policy.chunk_length, after_end="hold")
        data.setup()
        policy.set_statistics(data.statistics)
        weights = {f"policy.{name}": value for name, value in policy.state_dict().items()}
        content = {"state_dict": weights, "policy": describe(policy, data), "global_step": 7, "epoch": 0}
        write_checkpoint(folder / "policy_best.ckpt", content)
        return folder / "policy_best.ckpt"

    return write


@pytest.fixture
def tiny_act():
    """Builds an ACT of a few numbers that refines, with a branch and an uncertainty that do something."""

    def build(refine=Uncertainty, chunk_length=10):
        sizes = {"cvae_layers": 1, "dropout": 0.1, "backbone_stem": "unshuffle", "chunk_length": chunk_length}
        policy = deployed.tiny_act(False, refine=refine() if refine else None, **sizes)
        if refine:
            for layer in (policy.branch.head, policy.uncertainty_head):
                torch.nn.init.normal_(layer.weight)
        return policy

    return build


@pytest.fixture
def checkpoint(untrained, tiny_act, tmp_path):
    """`policy_best.ckpt` of such an ACT."""
    return untrained(tiny_act(), tmp_path)


class Calls(list):
    """What rollouts were asked for; `succeeds` and `crash` decide what comes of them."""

    crash: str | None = None

    @staticmethod
    def succeeds(seed, actor, execution):
        return seed % 2 == 0


@pytest.fixture
def world(monkeypatch):
    """Rollouts without a simulator; returns the calls."""
    calls = Calls()

    def simulate(actor, spec, simulators, on_result):
        options = {"actor": actor.name, "checkpoint": actor.checkpoint, "simulators": simulators}
        calls.append(vars(spec) | options)
        results = []
        for seed in spec.seeds:
            result = EpisodeResult(
                spec.task,
                spec.setting,
                seed,
                spec.seeds_hash,
                actor.name,
                actor.checkpoint,
                actor.called(spec.execution),
                calls.succeeds(seed, actor, spec.execution),
                10,
                refine_ratio=actor.refine_ratio,
                crash=calls.crash,
            )
            if seed in spec.videos:
                result.video = str(spec.videos[seed])
                Image.new("RGB", (4, 4)).save(result.video)
            if spec.out is not None:
                append_result(spec.out, result)
            results.append(result)
        return results

    monkeypatch.setattr("ugr_lightning.rollout.evaluate._run", simulate)
    return calls


TINY = """
trainer:
  max_steps: 6
  log_every_n_steps: 1
  accelerator: cpu
  enable_progress_bar: false
model:
  learning_rate: 0.01
  schedule: cosine
  policy:
    class_path: tiny.TinyPolicy
    init_args:
      dim: 14
      cameras: [cam_high, cam_right_wrist, cam_left_wrist]
data:
  root: {root}
  episodes: 5
  batch_size: 4
  val_stride: 3
  sampling:
    samples_per_epoch: 12
average:
  decay: 0.9
"""


@pytest.fixture
def tiny_config(tmp_path, monkeypatch, recording):
    """Config of a training that takes a second, in an empty working folder."""
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "tiny.yaml"
    path.write_text(TINY.replace("{root}", str(recording)))
    return str(path)

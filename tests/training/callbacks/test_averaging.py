import pytest
import torch
from lightning.pytorch import Callback
from tiny import TinyPolicy, train

from ugr_lightning.training.callbacks.averaging import WeightAverage


class Watch(Callback):
    """Keeps the weights after each step, and those that are validated."""

    def __init__(self):
        self.steps, self.validated, self.policy = [], [], None

    def on_train_batch_end(self, trainer, pl_module, *_):
        self.steps.append(pl_module.policy.head.weight.detach().clone())

    def on_validation_batch_start(self, trainer, pl_module, *_):
        self.validated.append(pl_module.policy.head.weight.detach().clone())


@pytest.mark.parametrize(
    ("power", "moves"), [(None, lambda step: 1 - (1 + step) / (10 + step)), (0.75, lambda step: (1 + step) ** -0.75)]
)
def test_the_average_is_what_is_validated_and_saved(power, moves, tmp_path, monkeypatch):
    monkeypatch.setattr("tiny.WeightAverage", lambda decay: WeightAverage(decay, power))
    watch, policy = Watch(), TinyPolicy()
    average = policy.head.weight.detach().clone()
    folder = tmp_path / "tiny" / "version_0"
    train(folder, policy, [watch], max_steps=5)
    for step, weight in enumerate(watch.steps, start=1):
        average.lerp_(weight, moves(step))
    saved = torch.load(folder / "last.ckpt", weights_only=True)
    assert torch.allclose(saved["state_dict"]["policy.head.weight"], average, atol=1e-6)
    assert torch.equal(saved["training_state_dict"]["policy.head.weight"], watch.steps[-1])
    assert torch.equal(watch.validated[0], saved["state_dict"]["policy.head.weight"])
    assert torch.equal(policy.head.weight, saved["state_dict"]["policy.head.weight"]), (
        "the result of fit is the average"
    )
    assert torch.equal(saved["state_dict"]["policy.mean"], torch.full((3,), 0.25)), "statistics do not drift"


def test_with_a_power_the_average_spans_more_steps_the_longer_training_lasts():
    average = WeightAverage(0.9999, power=0.75)
    assert average.decay_at(1) == 1 - 2**-0.75
    assert average.decay_at(30_000) < average.decay_at(300_000) == 0.9999
    assert WeightAverage(0.99).decay_at(1) == 2 / 11
    assert WeightAverage(0.99).decay_at(2000) == 0.99


def test_buffers_of_batch_normalisation_are_averaged_too(tmp_path):
    folder = tmp_path / "tiny" / "version_0"
    train(folder, max_steps=5)
    saved = torch.load(folder / "last.ckpt", weights_only=True)
    name = "policy.trunk.1.running_var"
    assert not torch.equal(saved["state_dict"][name], saved["training_state_dict"][name])


def test_no_decay_means_no_average(tmp_path, monkeypatch):
    monkeypatch.setattr("tiny.WeightAverage", lambda decay: WeightAverage(0.0))
    folder = tmp_path / "tiny" / "version_0"
    train(folder, max_steps=5)
    assert "training_state_dict" not in torch.load(folder / "last.ckpt", weights_only=True)

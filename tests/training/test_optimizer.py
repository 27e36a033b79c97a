"""Which optimiser trains what, and that two of them are as good as one for what saves, schedules and resumes."""

import io

import pytest
import torch
from deployed import looking_act
from lightning.pytorch import Trainer
from tiny import TinyPolicy
from torch.optim import AdamW
from torch.optim.lr_scheduler import LambdaLR

from ugr_lightning.errors import ConfigError
from ugr_lightning.training.module import PolicyModule
from ugr_lightning.training.optimizer import MuonAndAdamW, parts_of

RATE = 0.02


def some():
    torch.manual_seed(0)
    return [torch.nn.Parameter(torch.randn(*size)) for size in ((6, 4), (4, 4), (7,), (3, 2, 2))]


def joined(parameters):
    return MuonAndAdamW(parameters[:2], RATE, [{"params": parameters[2:], "lr": 1e-2}], weight_decay=0.1)


def give_gradients(parameters, step):
    torch.manual_seed(step)
    for parameter in parameters:
        parameter.grad = torch.randn_like(parameter)


def test_muon_trains_the_matrices_of_transformer_layers_and_nothing_else():
    policy = looking_act()
    acting, seeing, mixing = ([id(one) for one in part] for part in parts_of(policy, muon=True))
    everything = {id(one): name for name, one in policy.named_parameters()}
    assert sorted(acting + seeing + mixing) == sorted(everything)
    names = [everything[one] for one in mixing]
    assert {name.split(".")[0] for name in names} == {"encoder", "decoder"}
    assert {name.split(".", 2)[2] for name in names if name.startswith("encoder.0")} == {
        *("self_attn.in_proj_weight", "self_attn.out_proj.weight", "linear1.weight", "linear2.weight"),
    }
    assert not parts_of(policy, muon=False).mixing


class OwnPolicy(TinyPolicy):
    """Made of torch's own transformer layers, one of which sees."""

    def __init__(self):
        super().__init__()
        self.backbone = torch.nn.TransformerEncoderLayer(4, 2, 8)
        self.encoder, self.decoder = (
            torch.nn.TransformerEncoderLayer(4, 2, 8),
            torch.nn.TransformerDecoderLayer(4, 2, 8),
        )


def test_torchs_own_transformer_layers_are_found_but_what_sees_stays_with_its_own_rate():
    policy = OwnPolicy()
    policy.encoder.linear1.requires_grad_(False)
    acting, seeing, mixing = parts_of(policy, muon=True)
    assert {id(one) for one in seeing} == {id(one) for one in policy.backbone.parameters()}
    layers = torch.nn.ModuleList([policy.encoder, policy.decoder])
    matrices = {id(one) for one in layers.parameters() if one.dim() == 2 and one.requires_grad}
    assert {id(one) for one in mixing} == matrices
    assert len(matrices) == 9
    assert {id(one) for one in policy.trunk.parameters()} <= {id(one) for one in acting}


def test_the_module_gives_muon_its_own_rate():
    module = PolicyModule(looking_act(), learning_rate=3e-4, backbone_learning_rate=1e-3, muon_learning_rate=2e-3)
    module.trainer = Trainer(logger=False, enable_checkpointing=False, enable_progress_bar=False, max_steps=1)
    groups = module.configure_optimizers()["optimizer"].param_groups
    assert [group["lr"] for group in groups] == [3e-4, 1e-3, 2e-3]
    assert [len(group["params"]) for group in groups] == [len(part) for part in module.parts()]


def test_both_together_do_what_each_does_alone():
    ours, theirs = some(), some()
    together = joined(ours)
    alone = (
        torch.optim.Muon(theirs[:2], RATE, 0.1, adjust_lr_fn="match_rms_adamw"),
        AdamW(theirs[2:], 1e-2, weight_decay=0.1),
    )
    for step in range(5):
        give_gradients(ours, step)
        give_gradients(theirs, step)
        together.step()
        for optimizer in alone:
            optimizer.step()
    assert all(torch.equal(one, other) for one, other in zip(ours, theirs, strict=True))


def test_a_schedule_moves_the_rates_of_both():
    parameters = some()
    before = [parameter.clone() for parameter in parameters]
    optimizer = joined(parameters)
    LambdaLR(optimizer, lambda step: 0.0)
    give_gradients(parameters, 0)
    optimizer.step()
    assert all(torch.equal(one, other) for one, other in zip(parameters, before, strict=True))


def test_saved_and_restored_it_goes_on_as_if_it_had_not_stopped():
    straight, stopped = some(), some()
    optimizer, first = joined(straight), joined(stopped)
    for step in range(6):
        give_gradients(straight, step)
        optimizer.step()
    for step in range(3):
        give_gradients(stopped, step)
        first.step()
    file = io.BytesIO()
    torch.save(first.state_dict(), file)
    file.seek(0)
    second = joined(stopped)
    second.load_state_dict(torch.load(file, weights_only=True))
    for step in range(3, 6):
        give_gradients(stopped, step)
        second.step()
    assert all(torch.equal(one, other) for one, other in zip(straight, stopped, strict=True))


def test_a_torch_without_muon_is_named(monkeypatch):
    monkeypatch.delattr(torch.optim, "Muon")
    with pytest.raises(ConfigError, match=r"muon_learning_rate: expected torch 2\.9 or later, got "):
        PolicyModule(looking_act(), muon_learning_rate=1e-3).parts()
    assert PolicyModule(looking_act()).parts().acting

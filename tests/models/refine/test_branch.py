"""The residual branch."""

import torch

from ugr_lightning.models.refine.branch import ResidualBranch


def build() -> ResidualBranch:
    branch = ResidualBranch(16, 14)
    torch.nn.init.normal_(branch.head.weight)
    return branch


def inputs():
    return torch.randn(3, 10, 16), torch.randn(3, 10, 14)


def test_starts_at_zero():
    assert not ResidualBranch(16, 14)(*inputs()).any()


def test_computing_the_chosen_steps_equals_computing_all_and_masking():
    branch, (hidden, coarse) = build(), inputs()
    chosen = torch.zeros(3, 10, dtype=torch.bool)
    chosen[0, [1, 2, 9]] = chosen[1, [0, 4, 5]] = chosen[2, [6, 7, 8]] = True
    dense = branch(hidden, coarse) * chosen[..., None]
    assert dense.abs().sum() > 0
    assert torch.allclose(branch.at(chosen, 3, hidden, coarse), dense, atol=1e-6)


def test_corrects_each_step_by_itself():
    branch, (hidden, coarse) = build(), inputs()
    changed = hidden.clone()
    changed[:, 0] += 1
    difference = branch(changed, coarse) - branch(hidden, coarse)
    assert difference[:, 0].abs().max() > 1e-2
    assert difference[:, 1:].abs().max() < 1e-4


def test_depends_on_the_coarse_actions():
    branch, (hidden, coarse) = build(), inputs()
    assert not torch.allclose(branch(hidden, coarse), branch(hidden, coarse + 1))

"""The residual branch."""

import pytest
import torch

from ugr_lightning.models.refine.branch import ResidualBranch


def build(kind: str) -> ResidualBranch:
    branch = ResidualBranch(kind, 16, 2, 32, 0.0, 14).eval()
    torch.nn.init.normal_(branch.head.weight)
    return branch


def inputs():
    return (
        torch.randn(3, 10, 16),
        torch.randn(3, 10, 14),
        torch.randn(10, 16),
        (torch.randn(3, 7, 16), torch.randn(3, 7, 16)),
    )


@pytest.mark.parametrize("kind", ["mlp", "decoder"])
def test_starts_at_zero(kind):
    assert not ResidualBranch(kind, 16, 2, 32, 0.0, 14)(*inputs()).any()


def test_computing_the_chosen_steps_equals_computing_all_and_masking():
    branch, (hidden, coarse, *rest) = build("mlp"), inputs()
    chosen = torch.zeros(3, 10, dtype=torch.bool)
    chosen[0, [1, 2, 9]] = chosen[1, [0, 4, 5]] = chosen[2, [6, 7, 8]] = True
    dense = branch(hidden, coarse, *rest) * chosen[..., None]
    assert dense.abs().sum() > 0
    assert torch.allclose(branch.at(chosen, 3, hidden, coarse), dense, atol=1e-6)


def test_mlp_corrects_each_step_by_itself_and_the_decoder_looks_around():
    hidden, coarse, *rest = inputs()
    changed = hidden.clone()
    changed[:, 0] += 1
    for kind, moves in (("mlp", False), ("decoder", True)):
        branch = build(kind)
        assert branch.stepwise is not moves
        difference = branch(changed, coarse, *rest)[:, 1:] - branch(hidden, coarse, *rest)[:, 1:]
        assert bool(difference.abs().max() > 1e-4) is moves


@pytest.mark.parametrize("kind", ["mlp", "decoder"])
def test_depends_on_the_coarse_actions(kind):
    branch, (hidden, coarse, *rest) = build(kind), inputs()
    assert not torch.allclose(branch(hidden, coarse, *rest), branch(hidden, coarse + 1, *rest))

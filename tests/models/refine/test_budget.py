"""The budget of a trained policy, changed at run time."""

import pytest
import torch

from ugr_lightning.errors import ConfigError
from ugr_lightning.models.refine.block import Block
from ugr_lightning.models.refine.budget import with_refine_ratio
from ugr_lightning.models.refine.full import Full
from ugr_lightning.models.refine.tail import Tail
from ugr_lightning.models.refine.uncertainty import Uncertainty


def trained(tiny, refine):
    """A policy whose branch and head are no longer at their initial zeros."""
    policy = tiny(refine=refine).eval()
    torch.manual_seed(5)
    for layer in (policy.branch.head, policy.uncertainty_head):
        torch.nn.init.normal_(layer.weight)
    return policy


def test_ratio_zero_is_exactly_the_coarse_policy_and_ratio_one_exactly_full_refinement(tiny, batch):
    policy = trained(tiny, Uncertainty())
    planned = policy.predict(batch.observation)
    nothing = with_refine_ratio(policy, 0.0).predict(batch.observation)
    assert torch.equal(nothing.actions, planned.coarse)
    assert nothing.refined is None
    everything = with_refine_ratio(policy, 1.0).predict(batch.observation)
    full = tiny(refine=Full(), uncertainty_head=True).eval()
    full.load_state_dict(policy.state_dict())
    assert torch.equal(everything.actions, full.predict(batch.observation).actions)
    assert everything.refined.all()
    assert not torch.allclose(everything.actions, everything.coarse)


def test_budgets_are_nested_and_cost_what_they_say(tiny, batch):
    policy, before = trained(tiny, Uncertainty()), None
    for ratio in (0.1, 0.3, 0.5, 0.9, 1.0):
        chunk = with_refine_ratio(policy, ratio).for_inference().predict(batch.observation)
        assert chunk.refined.sum(1).tolist() == [round(10 * ratio)] * 3
        assert torch.equal(chunk.coarse[~chunk.refined], chunk.actions[~chunk.refined])
        assert before is None or not (before & ~chunk.refined).any()
        before = chunk.refined


def test_the_policy_itself_keeps_its_budget(tiny, batch):
    policy = trained(tiny, Uncertainty())
    with_refine_ratio(policy, 0.0)
    with_refine_ratio(policy, 1.0)
    assert policy.predict(batch.observation).refined.sum(1).tolist() == [3, 3, 3]


def test_any_ranking_selector_can_be_rebudgeted_and_no_other(tiny):
    assert with_refine_ratio(tiny(refine=Tail()), 0.5).budget == 5
    for refine in (None, Full(), Block(3)):
        with pytest.raises(ConfigError, match="ranks"):
            with_refine_ratio(tiny(refine=refine), 0.5)
    for ratio in (-0.1, 1.1):
        with pytest.raises(ConfigError, match="share"):
            with_refine_ratio(tiny(refine=Tail()), ratio)

"""The offline sweep over budgets against policies that really have them."""

import numpy as np
import pytest
import torch
from deployed import tiny_act

from ugr_lightning.contract import Observation
from ugr_lightning.models.refine.budget import with_refine_ratio
from ugr_lightning.models.refine.tail import Tail
from ugr_lightning.models.refine.uncertainty import Uncertainty
from ugr_lightning.uncertainty.budgets import (
    RATIOS,
    budget_errors,
    refined_error,
    sweep,
    sweep_figure,
    sweep_table,
)
from ugr_lightning.uncertainty.predictions import Predictions

N, K = 12, 10


def policy():
    built = tiny_act(refine=Uncertainty())
    for layer in (built.branch.head, built.uncertainty_head):
        torch.nn.init.normal_(layer.weight)
    return built


def predictions(act):
    """Errors against a made-up target; some steps are padded."""
    draw = torch.Generator().manual_seed(1)
    images = torch.randint(0, 256, (N, 3, 3, 32, 32), dtype=torch.uint8, generator=draw)
    chunk = act.predict(Observation(images, torch.randn(N, 14, generator=draw)))
    target = torch.randn(N, K, 14, generator=draw)
    coarse = chunk.actions if chunk.coarse is None else chunk.coarse
    errors = [(actions - target).norm(dim=-1).double().numpy() for actions in (coarse, chunk.actions)]
    return Predictions(*errors, chunk.log_variance.double().numpy(), None, np.arange(N) // 3, np.arange(N))


def test_offline_errors_are_those_of_a_policy_with_that_budget():
    act = policy()
    everything = predictions(with_refine_ratio(act, 1.0))
    for ratio in (0.1, 0.3, 0.7, 1.0):
        really = predictions(with_refine_ratio(act, ratio)).executed
        offline = refined_error(everything, Uncertainty(ratio), everything.log_variance)
        assert np.allclose(offline, really, atol=1e-5)
    assert np.array_equal(predictions(with_refine_ratio(act, 0.0)).executed, everything.coarse)


def test_the_sweep_starts_at_coarse_ends_at_full_and_no_rule_beats_the_one_that_knows_the_gain():
    everything = predictions(with_refine_ratio(policy(), 1.0))
    worse_first = np.arange(float(K))[None, ::-1]
    found = sweep(everything, worse_first, resamples=20)
    assert found.error["prior"] == found.error["head"] != found.error["tail"]
    assert found.ratios == RATIOS
    for name, intervals in found.error.items():
        assert intervals[0].value == pytest.approx(everything.coarse.mean())
        assert intervals[-1].value == pytest.approx(everything.executed.mean())
        for best, other in zip(found.error["gain"], intervals, strict=True):
            assert best.value <= other.value + 1e-12, name
    assert found.against_coarse["learned"][0] == (0, 0, 0)
    assert len(sweep_table(found)) == 12
    assert len(sweep_figure(found).axes[0].lines) == 7


@pytest.mark.parametrize("selector", [Uncertainty, Tail])
def test_the_error_of_each_budget_is_that_of_the_policys_own_selector(selector):
    act = policy()
    act.refine = selector()
    everything = predictions(with_refine_ratio(act, 1.0))
    found = budget_errors(act, everything, (0.0, 0.3, 1.0))
    own = predictions(with_refine_ratio(act, 0.3)).executed
    wanted = [everything.coarse.mean(), own.mean(), everything.executed.mean()]
    assert [one.error.value for one in found] == pytest.approx(wanted, abs=1e-6)
    assert found[0].against_coarse == (0, 0, 0)
    assert found[1].against_coarse.value == pytest.approx(wanted[1] - wanted[0], abs=1e-6)


def test_padded_steps_are_neither_chosen_nor_counted():
    everything = predictions(with_refine_ratio(policy(), 1.0))
    everything.coarse[:, 6:] = np.nan
    everything.executed[:, 6:] = np.nan
    error = refined_error(everything, Uncertainty(0.3), everything.log_variance)
    assert np.isnan(error[:, 6:]).all()
    assert (error[:, :6] != everything.coarse[:, :6]).sum(1).tolist() == [3] * N
    found = sweep(everything, np.ones((2, K)), (0.0, 1.0), resamples=5)
    assert found.error["tail"][1].value == pytest.approx(everything.executed[:, :6].mean())

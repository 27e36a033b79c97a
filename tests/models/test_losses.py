"""The paper's equations against numbers worked out by hand."""

import math

import pytest
import torch

from ugr_lightning.models import losses

TARGET = torch.zeros(1, 3, 2)
COARSE = torch.tensor([[[1.0, 2.0], [0.0, 3.0], [10.0, 10.0]]])  # squared errors 5, 9, 200; mean absolute 1.5, 1.5, 10
VALID = torch.tensor([[True, True, False]])


def test_coarse_loss_sums_over_the_action_and_averages_over_valid_steps():
    assert losses.coarse_loss(COARSE, TARGET, VALID).item() == pytest.approx((5 + 9) / 2)


def test_l1_averages_over_the_action_too():
    assert losses.coarse_loss(COARSE, TARGET, VALID, "l1").item() == pytest.approx(1.5)


def test_refine_loss_averages_over_chosen_steps_only():
    refined = torch.tensor([[False, True, False]])
    assert losses.refine_loss(COARSE, TARGET, refined, VALID).item() == pytest.approx(9)


def test_refine_loss_ignores_padded_steps_and_is_zero_when_nothing_is_chosen():
    refined = torch.tensor([[False, False, True]])
    assert losses.refine_loss(COARSE, TARGET, refined, VALID).item() == 0


def test_uncertainty_loss_is_the_heteroscedastic_likelihood():
    log_variance = torch.tensor([[0.0, math.log(9), 5.0]])
    expected = ((5 / 1 + 0) + (9 / 9 + math.log(9))) / 2
    assert losses.uncertainty_loss(COARSE, TARGET, log_variance, VALID).item() == pytest.approx(expected)


def test_uncertainty_loss_is_least_where_the_variance_equals_the_squared_error():
    log_variance = torch.tensor([[math.log(5), math.log(9), 0.0]], requires_grad=True)
    losses.uncertainty_loss(COARSE, TARGET, log_variance, VALID).backward()
    assert log_variance.grad is not None
    assert torch.allclose(log_variance.grad, torch.zeros(1, 3), atol=1e-6)


def test_uncertainty_loss_sends_no_gradient_into_the_coarse_actions():
    coarse = COARSE.clone().requires_grad_()
    log_variance = torch.zeros(1, 3, requires_grad=True)
    losses.uncertainty_loss(coarse, TARGET, log_variance, VALID).backward()
    assert coarse.grad is None


def test_kl_sums_over_the_latent_and_averages_over_the_batch():
    mean, log_variance = torch.tensor([[1.0, 0.0], [0.0, 0.0]]), torch.tensor([[0.0, math.log(4)], [0.0, 0.0]])
    expected = (0.5 + 0.5 * (4 - 1 - math.log(4)) + 0) / 2
    assert losses.kl_loss(mean, log_variance).item() == pytest.approx(expected)


def test_total_weighs_each_term():
    terms = {
        name: torch.tensor(value)
        for name, value in (("coarse", 1.0), ("refine", 2.0), ("uncertainty", 3.0), ("kl", 4.0))
    }
    assert losses.total_loss(terms, uncertainty_weight=0.5, kl_weight=10).item() == pytest.approx(1 + 2 + 1.5 + 40)


def test_terms_are_float32_even_for_bf16_predictions():
    assert losses.coarse_loss(COARSE.bfloat16(), TARGET, VALID).dtype == torch.float32

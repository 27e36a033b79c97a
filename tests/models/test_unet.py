"""The U-Net: its size, and what its output depends on."""

import pytest
import torch

from ugr_lightning.errors import ConfigError
from ugr_lightning.models.unet import ConditionalUNet, encode_step


def small(widths=(8, 16, 24)) -> ConditionalUNet:
    return ConditionalUNet(3, 5, widths)


@pytest.mark.parametrize("length", [1, 6, 8, 50])
def test_a_chunk_of_any_length_keeps_its_length(length):
    noisy = torch.randn(2, length, 3)
    predicted = small()(noisy, torch.tensor([0, 99]), torch.randn(2, 5))
    assert predicted.shape == noisy.shape
    assert predicted.dtype == torch.float32


def test_every_input_matters_and_every_parameter_learns():
    unet = small()
    noisy, step, condition = torch.randn(2, 8, 3), torch.tensor([3, 40]), torch.randn(2, 5)
    before = unet(noisy, step, condition)
    assert not torch.allclose(unet(noisy, step + 10, condition), before, atol=1e-4)
    assert not torch.allclose(unet(noisy, step, condition + 1), before, atol=1e-4)
    assert not torch.allclose(unet(noisy + 1, step, condition), before, atol=1e-4)
    before.square().mean().backward()
    assert [name for name, p in unet.named_parameters() if p.grad is None or not p.grad.any()] == []


def test_the_last_step_can_see_the_first():
    unet = small().eval()
    noisy = torch.randn(1, 16, 3, requires_grad=True)
    unet(noisy, torch.tensor([5]), torch.randn(1, 5))[0, -1].sum().backward()
    assert noisy.grad[0, 0].abs().sum() > 0


def test_rows_do_not_influence_each_other():
    unet = small()
    noisy, step, condition = torch.randn(3, 8, 3), torch.tensor([1, 2, 3]), torch.randn(3, 5)
    together = unet(noisy, step, condition)
    assert torch.allclose(together[1:2], unet(noisy[1:2], step[1:2], condition[1:2]), atol=1e-5)


def test_diffusion_steps_are_told_apart():
    encoded = encode_step(torch.arange(100))
    assert encoded.shape == (100, 128)
    distance = torch.cdist(encoded, encoded) + 10 * torch.eye(100)
    assert distance.min() > 0.1


@pytest.mark.parametrize("widths", [(8, 12), ()])
def test_impossible_widths_are_refused_by_name(widths):
    with pytest.raises(ConfigError, match="unet_widths"):
        small(widths)

"""The network of Diffusion Policy: a U-Net over the steps of a chunk, conditioned by FiLM."""

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

from ugr_lightning.errors import ConfigError
from ugr_lightning.models.precision import full_precision

KERNEL = 5
"""Steps that a convolution sees."""
GROUPS = 8
"""Groups of the normalisation."""
STEP_DIM = 128
"""Numbers that encode the diffusion step."""


class ConvBlock(nn.Sequential):
    """Convolution over the steps, group normalisation, Mish.

    Args:
        inputs, outputs: channels.
    """

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(
            nn.Conv1d(inputs, outputs, KERNEL, padding=KERNEL // 2), nn.GroupNorm(GROUPS, outputs), nn.Mish()
        )


class ResidualBlock(nn.Module):
    """Two convolutions with a shortcut; the condition scales and shifts the channels between them.

    Args:
        inputs, outputs: channels.
        condition: numbers in the condition.
    """

    def __init__(self, inputs: int, outputs: int, condition: int) -> None:
        super().__init__()
        self.first = ConvBlock(inputs, outputs)
        self.film = nn.Linear(condition, 2 * outputs)
        self.second = ConvBlock(outputs, outputs)
        self.shortcut = nn.Conv1d(inputs, outputs, 1) if inputs != outputs else nn.Identity()

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        """(B, inputs, L) and an activated condition (B, C) to (B, outputs, L)."""
        scale, shift = self.film(condition)[..., None].chunk(2, dim=1)  # (B, outputs, 1) each
        y: Tensor = self.second(scale * self.first(x) + shift) + self.shortcut(x)
        return y


class Level(nn.Module):
    """Two residual blocks, the first of which may change the number of channels; arguments as theirs."""

    def __init__(self, inputs: int, outputs: int, condition: int) -> None:
        super().__init__()
        self.first = ResidualBlock(inputs, outputs, condition)
        self.second = ResidualBlock(outputs, outputs, condition)

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        """(B, inputs, L) and an activated condition (B, C) to (B, outputs, L)."""
        y: Tensor = self.second(self.first(x, condition), condition)
        return y


class ConditionalUNet(nn.Module):
    """Predicts the noise in a chunk, or what else it was trained for, from the noisy chunk and a condition.

    Every level but the last halves the number of steps; a length that cannot be halved so often is padded here.

    Args:
        channels: numbers per step, A.
        condition: numbers in the condition.
        widths: channels of each level.

    Raises:
        ConfigError: no level, or widths that the groups do not divide.

    Source: RoboTwin-Platform/RoboTwin@13c3c47, policy/DP/diffusion_policy/model/diffusion/conditional_unet1d.py.
    """

    def __init__(self, channels: int, condition: int, widths: Sequence[int] = (256, 512, 1024)) -> None:
        super().__init__()
        if not widths or any(width % GROUPS for width in widths):
            raise ConfigError("unet_widths", f"multiples of {GROUPS}", list(widths), "Change the widths.")
        self.multiple = 2 ** (len(widths) - 1)
        self.step_embed = nn.Sequential(nn.Linear(STEP_DIM, 4 * STEP_DIM), nn.Mish(), nn.Linear(4 * STEP_DIM, STEP_DIM))
        levels, told = list(pairwise((channels, *widths))), condition + STEP_DIM
        self.down = nn.ModuleList(Level(inputs, outputs, told) for inputs, outputs in levels)
        self.downsample = nn.ModuleList(nn.Conv1d(width, width, 3, 2, 1) for width in widths[:-1])
        self.middle = Level(widths[-1], widths[-1], told)
        self.up = nn.ModuleList(Level(2 * outputs, inputs, told) for inputs, outputs in reversed(levels[1:]))
        self.upsample = nn.ModuleList(nn.ConvTranspose1d(width, width, 4, 2, 1) for width in reversed(widths[:-1]))
        self.last = ConvBlock(widths[0], widths[0])
        self.head = nn.Conv1d(widths[0], channels, 1)

    def forward(self, noisy: Tensor, step: Tensor, condition: Tensor) -> Tensor:
        """The prediction for one diffusion step of each sample.

        Args:
            noisy: (B, L, A) noisy chunk, normalised.
            step: (B,) diffusion steps, 0 for the least noise.
            condition: (B, C).

        Returns:
            (B, L, A) float32.
        """
        length = noisy.shape[1]
        x = functional.pad(noisy.transpose(1, 2), (0, -length % self.multiple))  # (B, A, L')
        embedded = self.step_embed(encode_step(step))  # (B, E)
        condition = functional.mish(torch.cat([embedded, condition.to(embedded.dtype)], dim=1))  # (B, E + C)
        skipped = []
        for number, level in enumerate(self.down):
            x = level(x, condition)  # (B, width, L' / 2^number)
            skipped.append(x)
            if number < len(self.downsample):
                x = self.downsample[number](x)
        x = self.middle(x, condition)
        for level, upsample in zip(self.up, self.upsample, strict=True):
            x = torch.cat([x, skipped.pop()], dim=1)  # (B, 2 width, L' / 2^number)
            x = upsample(level(x, condition))
        x = self.last(x)[..., :length]  # (B, width, L); the first level has no skip, as in the public code
        with full_precision(x.device):
            predicted: Tensor = self.head(x.float()).transpose(1, 2)  # (B, L, A)
        return predicted


def encode_step(step: Tensor) -> Tensor:
    """Sines and cosines of a diffusion step.

    Args:
        step: (B,) diffusion steps.

    Returns:
        (B, E) float32, E being `STEP_DIM`.
    """
    half = STEP_DIM // 2
    rates = torch.exp(torch.arange(half, device=step.device) * (-math.log(10000) / (half - 1)))  # (E / 2,)
    angles = step[:, None] * rates  # (B, E / 2)
    return torch.cat([angles.sin(), angles.cos()], dim=1)

"""Making a network cheaper to query, once it no longer has to learn."""

from collections.abc import Collection

import torch
from torch import nn

from ugr_lightning.models.transformer import Attention
from ugr_lightning.models.vision import BasicBlock, FrozenBatchNorm2d, ResNet18


def fold_normalisation(backbone: ResNet18) -> None:
    """Merge every normalisation with fixed statistics into the convolution before it, in place.

    Args:
        backbone: one with `frozen` or `batch` norm; group norm depends on its input and stays.
    """
    for block in backbone.modules():
        if isinstance(block, (BasicBlock, ResNet18)):
            block.bn1 = _fold(block.conv1, block.bn1)
        if isinstance(block, BasicBlock):
            block.bn2 = _fold(block.conv2, block.bn2)
            if block.downsample is not None:
                conv, norm = block.downsample
                assert isinstance(conv, nn.Conv2d)
                block.downsample[1] = _fold(conv, norm)


def store_weights_as(module: nn.Module, dtype: torch.dtype, keep: Collection[str]) -> None:
    """Convert the weights of matrix products, in place, so that autocast need not do it at every query.

    Args:
        module: what to convert.
        dtype: the arithmetic of its trunk.
        keep: names of the parts that stay as they are, with all that is in them.
    """
    for name, layer in module.named_modules():
        weighs = isinstance(layer, (nn.Conv1d, nn.Conv2d, nn.ConvTranspose1d, nn.Linear, Attention))
        if weighs and not any(f"{name}.".startswith(f"{part}.") for part in keep):
            for parameter in layer.parameters(recurse=False):
                parameter.data = parameter.data.to(dtype)


def _fold(conv: nn.Conv2d, norm: nn.Module) -> nn.Module:
    """Put a normalisation into a convolution and return what is left of it."""
    if isinstance(norm, FrozenBatchNorm2d):
        scale, shift = norm.scale_and_shift()
    elif isinstance(norm, nn.BatchNorm2d):
        assert norm.running_var is not None
        assert norm.running_mean is not None
        scale = norm.weight * (norm.running_var + norm.eps).rsqrt()
        shift = norm.bias - norm.running_mean * scale
    else:
        return norm
    conv.weight = nn.Parameter(conv.weight * scale[:, None, None, None], requires_grad=False)
    conv.bias = nn.Parameter(shift, requires_grad=False)
    return nn.Identity()

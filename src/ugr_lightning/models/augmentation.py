"""Random changes to images that leave the right action as it is."""

import torch
from torch import Tensor


def shift_images(images: Tensor, pixels: int) -> Tensor:
    """Move each image by up to `pixels` in x and y, repeating its border.

    Args:
        images: (n, 3, H, W), channels last in memory.
        pixels: largest displacement.

    Returns:
        (n, 3, H, W), channels last in memory.
    """
    n, _, height, width = images.shape
    device = images.device
    offset = torch.randint(-pixels, pixels + 1, (2, n, 1), device=device)
    rows = (torch.arange(height, device=device) + offset[0]).clamp(0, height - 1)  # (n, H)
    columns = (torch.arange(width, device=device) + offset[1]).clamp(0, width - 1)  # (n, W)
    image = torch.arange(n, device=device)[:, None, None]
    return images.permute(0, 2, 3, 1)[image, rows[:, :, None], columns[:, None]].permute(0, 3, 1, 2)


def jitter_colour(images: Tensor, strength: float, cameras: int) -> Tensor:
    """Change contrast and brightness, equally for all cameras of a sample.

    Args:
        images: (B * cameras, 3, H, W) float, normalised.
        strength: largest relative change of contrast, and largest change of brightness in standard deviations.
        cameras: V.

    Returns:
        (B * cameras, 3, H, W).
    """
    draw = 2 * torch.rand(2, images.shape[0] // cameras, 1, 1, 1, device=images.device) - 1
    contrast, brightness = (strength * draw).repeat_interleave(cameras, dim=1)  # (B * cameras, 1, 1, 1) each
    return images * (1 + contrast) + brightness

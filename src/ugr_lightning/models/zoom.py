"""A second look: the pixels around where the maps have found a hand's next keyframe, as fine as they are."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from ugr_lightning.models.augmentation import jitter_colour

FARTHEST = 3.0
"""The largest correction, in standard deviations of the displacement in training."""
NEAR = 0.02
"""A point nearer to a camera's plane, m, is not in its picture."""
CHANNELS = 24
"""Of the first of four layers that look at a crop; the others have twice as many."""
EDGE = 1.2
"""Where a crop's middle may be, in image units; 1 is the edge of the picture."""


class Closer(NamedTuple):
    """What the second look gives.

    Args:
        correction: (B, 2, 3) from the points that were looked at to those that are meant, in standard deviations of the
            displacement in training.
        axes: (B, 2, axes) which way round the tools are.
    """

    correction: Tensor
    axes: Tensor


class Zoom(nn.Module):
    """Corrects a point of each arm, and reads its orientation, in crops of all pictures around the point.

    A backbone sees cells of several pixels, and a whole scene: it is slow to learn what a few pixels decide. A crop
    around the place in question holds little else. In training the points are the true ones, displaced at random, so
    that only the pictures can say by how much.

    Args:
        side: S, pixels of a crop, a multiple of 8.
        cameras: V.
        axes: numbers that tell an orientation.
        levels: L, crops of each place; each shows twice as much as the one before it, half as fine.

    Source: RVT-2 (arXiv:2406.08545) looks a second time where a coarse stage points; docs/recipe.md (the second look).
    """

    def __init__(self, side: int, cameras: int, axes: int, levels: int = 1) -> None:
        super().__init__()
        self.side, self.levels, wide, told = side, levels, 2 * CHANNELS, 64
        self.eyes = nn.ModuleList(
            nn.Sequential(
                *_layer(3, CHANNELS, 1),
                *_layer(CHANNELS, wide, 2),
                *_layer(wide, wide, 2),
                *_layer(wide, wide, 2),
                nn.Flatten(),
                nn.Linear(wide * (side // 8) ** 2, told),
            )
            for _ in range(levels * cameras)
        )
        known = (told * levels + 1) * cameras + 3 + 2  # what each camera sees and whether; where; both grippers
        self.hands = nn.ModuleList(
            nn.Sequential(nn.Linear(known, 2 * told), nn.ReLU(), nn.Linear(2 * told, 3 + axes)) for _ in range(2)
        )

    def forward(
        self, pictures: Tensor, projection: Tensor, points: Tensor, where: Tensor, grips: Tensor, jitter: float = 0.0
    ) -> Closer:
        """Look at both arms' points.

        Args:
            pictures: (B, V, 3, H, W) uint8.
            projection: (B, V, 3, 4) of the pictures as they are.
            points: (B, 2, 3) m, where to look.
            where: (B, 2, 3) the same, normalised.
            grips: (B, 2) how open the grippers are, normalised.
            jitter: largest random relative change of contrast and brightness.
        """
        shown = [crop(pictures, projection, points, self.side, level) for level in range(self.levels)]
        crops, inside = torch.cat([squares for squares, _ in shown], 1), shown[0][1]  # (B, L V, 2, 3, S, S), (B, V, 2)
        if jitter:
            crops = jitter_colour(crops.flatten(0, 2), jitter, crops.shape[1] * crops.shape[2]).view_as(crops)
        crops = crops * inside.repeat(1, self.levels, 1)[..., None, None, None]
        seen = [eye(crops[:, camera].flatten(0, 1)).unflatten(0, (-1, 2)) for camera, eye in enumerate(self.eyes)]
        told = [*seen, inside.transpose(1, 2).to(where.dtype), where, grips[:, None].expand(-1, 2, -1)]
        known = torch.cat(told, dim=-1)  # (B, 2, known)
        answers = torch.stack([hand(known[:, arm]) for arm, hand in enumerate(self.hands)], dim=1)  # (B, 2, 3 + axes)
        correction, axes = answers[..., :3], answers[..., 3:]
        return Closer(correction if self.training else correction.clamp(-FARTHEST, FARTHEST), axes)


def crop(pictures: Tensor, projection: Tensor, points: Tensor, side: int, level: int = 0) -> tuple[Tensor, Tensor]:
    """Squares of pixels around points of the world, in every picture.

    Args:
        pictures: (B, V, 3, H, W) uint8.
        projection: (B, V, 3, 4).
        points: (B, n, 3) m.
        side: S.
        level: pictures are halved so often before.

    Returns:
        (B, V, n, 3, S, S) float32, -1 to 1, borders repeated; (B, V, n) whether a point is in or near the picture.
    """
    size = points.new_tensor([pictures.shape[4] >> level, pictures.shape[3] >> level])
    matrix, offset = projection[:, :, None, :, :3], projection[:, :, None, :, 3]
    seen = (matrix @ points[:, None, ..., None]).squeeze(-1) + offset  # (B, V, n, 3)
    depth = seen[..., 2]
    middle = seen[..., :2] / depth.clamp(min=NEAR)[..., None]  # (B, V, n, 2) u, v in image units
    inside = (depth > NEAR) & (middle.abs().amax(-1) < EDGE)
    first = (middle + 1) / 2 * size - side / 2  # (B, V, n, 2) pixels
    whole = first.floor()
    within = torch.arange(side + 1, device=points.device)  # a crop lies between pixels
    places = (whole.long()[..., None] + within).clamp(min=0).minimum(size.long()[:, None] - 1)  # (B, V, n, 2, S + 1)
    if level:
        finer = torch.arange(1 << level, device=points.device)
        places = ((places << level)[..., None] + finer).flatten(-2)  # (B, V, n, 2, 2^level (S + 1))
    batch, camera = (torch.arange(length, device=points.device) for length in pictures.shape[:2])
    columns, rows = places[..., 0, None, :], places[..., 1, :, None]
    pixels = pictures.movedim(2, -1)[batch[:, None, None, None, None], camera[:, None, None, None], rows, columns]
    squares = pixels.float() / 127.5 - 1  # (B, V, n, S + 1, S + 1, 3)
    if level:
        squares = squares.unflatten(4, (side + 1, -1)).mean(5).unflatten(3, (side + 1, -1)).mean(4)
    right, down = (first - whole)[..., None, None, None].unbind(3)  # (B, V, n, 1, 1, 1) shares of the next pixel
    squares = squares[..., :-1, :, :].lerp(squares[..., 1:, :, :], down)
    squares = squares[..., :-1, :].lerp(squares[..., 1:, :], right)  # (B, V, n, S, S, 3)
    return squares.movedim(-1, 3), inside


def _layer(inputs: int, outputs: int, stride: int) -> tuple[nn.Module, ...]:
    return nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False), nn.BatchNorm2d(outputs), nn.ReLU()

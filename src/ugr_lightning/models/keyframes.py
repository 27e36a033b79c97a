"""Where each hand will grip next: maps over the pictures, told in training, and one point in space per arm from all.

A fully convolutional map that is classified per pixel learns at one place what holds at all places. The labels are
free: the calibration of the cameras projects the tool's pose at its next keyframe into every picture.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from ugr_lightning.contract import Keyframes, Statistics
from ugr_lightning.errors import ConfigError
from ugr_lightning.models.precision import full_precision
from ugr_lightning.models.zoom import NEAR, Zoom

ARMS, POINTS, AXES = 2, 2, 6
"""Left and right; the tool and its foot on the table; numbers of two axes."""
FEATURES = 3 + 3 + AXES
"""Numbers told of each arm: where, how sure, which way round."""
SHY = 7.0
"""First log-odds of `not in this picture`; a map of 1200 equal cells has log 1200 = 7.1 against one cell."""
AXES_NOISE = 0.03
"""Standard deviation, in training, of the noise on the axes that the policy is told."""
AGREES = 0.025
"""A ray that misses the point by so much of half a picture, two pixels of 160, counts for a quarter."""


@dataclass(frozen=True)
class KeyframeSettings:
    """How keyframes are looked for.

    Args:
        channels: of the maps' features.
        weight: of the maps' loss in the policy's loss.
        noise: standard deviation, in image units, of the noise on the peaks that the policy is told in training.
        table_height: height of the table in the world, m, where the foot of a tool is.
        context: dilations of further convolutions of the maps' features, which see farther around.
        grips: tell the maps how open the grippers are: whether one has let go already, a picture hardly shows.
        zoom: pixels on a side of the crops in which a second look corrects what the maps find; 0 for none.
        zoom_levels: crops of each place, each of twice the field of view of the one before.
        displaced: standard deviation, m, of what the second look learns to correct.
    """

    channels: int = 64
    weight: float = 0.05
    noise: float = 0.002
    table_height: float = 0.0
    context: tuple[int, ...] = ()
    grips: bool = False
    zoom: int = 0
    zoom_levels: int = 1
    displaced: float = 0.015

    def __post_init__(self) -> None:
        if self.zoom not in range(0, 129, 8):
            raise ConfigError("keyframes.zoom", "0 or a multiple of 8 pixels, at most 128", self.zoom, "Use 0, or 32.")
        if self.zoom_levels not in range(1, 5):
            raise ConfigError("keyframes.zoom_levels", "1 to 4", self.zoom_levels, "Use 1, or 2 for larger pictures.")
        if not 0 < self.displaced < math.inf:
            raise ConfigError("keyframes.displaced", "a distance above 0, m", self.displaced, "Use 0.015.")


class Sighting(NamedTuple):
    """What was found in the pictures of all cameras.

    Args:
        features: (B, 2 * FEATURES) float32, what the policy is told.
        maps, points: as in `Chunk`.
        terms: scalars, `keyframe` to minimise, others for the log; empty without labels.
    """

    features: Tensor
    maps: Tensor
    points: Tensor
    terms: dict[str, Tensor]


class KeyframeFinder(nn.Module):
    """Classifies every cell of a map at a quarter of the resolution, and solves the peaks' rays for points in space.

    Args:
        settings: see there.
        widths: channels of the first three stages of the backbone.
        cameras: V.

    Source: docs/recipe.md (keyframes).
    """

    centre: Tensor
    spread: Tensor

    def __init__(self, settings: KeyframeSettings, widths: tuple[int, int, int], cameras: int) -> None:
        super().__init__()
        self.settings, channels, maps = settings, settings.channels, ARMS * POINTS
        self.laterals = nn.ModuleList(nn.Conv2d(width, channels, 1) for width in widths)
        self.camera_embed = nn.Parameter(0.02 * torch.randn(cameras, channels))
        self.smooth = nn.Conv2d(channels, channels, 3, padding=1)
        self.context = nn.ModuleList(nn.Conv2d(channels, channels, 3, padding=d, dilation=d) for d in settings.context)
        self.grips = nn.Linear(ARMS, channels) if settings.grips else None
        self.maps = nn.Conv2d(channels, maps, 1)
        self.absent = nn.Linear(2 * channels, maps)
        self.zoom = Zoom(settings.zoom, cameras, AXES, settings.zoom_levels) if settings.zoom else None
        self.axes = nn.Linear(POINTS * channels, AXES) if self.zoom is None else None
        self.register_buffer("centre", torch.zeros(ARMS, 3))
        self.register_buffer("spread", torch.ones(ARMS, 3))

    def fit(self, statistics: Statistics) -> None:
        """Store where keyframes of the training episodes are.

        Raises:
            ConfigError: the data have no keyframes.
        """
        if statistics.keyframe_mean is None or statistics.keyframe_std is None:
            raise missing_keyframes("demonstrations of which some or all lack them (`ugr data inspect` says what)")
        self.centre.copy_(statistics.keyframe_mean)
        self.spread.copy_(statistics.keyframe_std)

    def forward(
        self,
        stages: tuple[Tensor, Tensor, Tensor],
        projection: Tensor,
        shift: Tensor,
        grips: Tensor,
        pictures: Tensor,
        labels: Keyframes | None = None,
        jitter: float = 0.0,
    ) -> Sighting:
        """Find the keyframes of both arms.

        Args:
            stages: (B V, C, h, w) features of the backbone's first three stages; the first sets the maps' resolution.
            projection: (B, V, 3, 4), see `embodiment.image_projection`.
            shift: (B V, 2) how far each picture was moved, in image units.
            grips: (B, 2) how open the grippers are, normalised.
            pictures: (B, V, 3, H, W) uint8, as they were before they were moved.
            labels: what is to be found, in training and validation.
            jitter: largest random relative change of a crop's contrast and brightness.
        """
        features = self._features(stages, projection.shape[1], grips)  # (B V, C, h, w)
        chances = self._chances(features)  # (B V, 4, h w + 1) float32, logarithms
        with full_precision(features.device):  # millimetres need all digits
            cameras, cells = projection.shape[1], features.shape[2:]
            maps = chances[..., :-1].exp().unflatten(2, cells)  # (B V, 4, h, w)
            place, mass, window = peak(maps)  # (B V, 4, ...)
            points, doubts = self._points(place, mass, shift, projection)  # (B, 2, 3) each
            if self.zoom is None:
                axes, miss = self._axes(features.float(), window, cameras), points.new_zeros(())  # (B, 2, 6), ()
            else:
                points, axes, miss = self._look_again(pictures, projection, points, grips, labels, jitter)
            terms: dict[str, Tensor] = {}
            if labels is not None:
                told, pixels = self._map_terms(chances, place, shift, projection, labels, cells, pictures.shape[3:])
                terms["keyframe"] = told + miss + 3 * (axes - labels.axes).abs().mean()
                terms["keyframe_px"] = pixels
                terms["keyframe_mm"] = 1000 * (points - labels.position).norm(dim=-1).median()
            axes = axes.detach()
            if self.training and self.settings.noise:
                axes = axes + AXES_NOISE * torch.randn_like(axes)
            summary = torch.cat([self._normalised(points), doubts, axes], dim=-1).flatten(1)  # (B, 2 FEATURES)
            maps = maps.detach().unflatten(0, (-1, cameras)).unflatten(2, (ARMS, POINTS))  # (B, V, 2, 2, h, w)
            return Sighting(summary, maps, self._with_feet(points), terms)

    def _points(self, place: Tensor, mass: Tensor, shift: Tensor, projection: Tensor) -> tuple[Tensor, Tensor]:
        """Points (B, 2, 3) in m that the maps' peaks agree on, and (B, 2, 3) how well they do; without gradient."""
        told = (place + shift[:, None]).detach()  # (B V, 4, 2), in the picture as it was
        if self.training and self.settings.noise:
            told = told + self.settings.noise * torch.randn_like(told)
        shape = (-1, projection.shape[1], ARMS, POINTS)
        mass = mass.detach() * (told.abs().amax(-1) < 1)  # (B V, 4); shifted out of the picture, nothing is known
        points, misses, support = self.solve(told.view(*shape, 2), mass.view(shape), projection)
        sure = mass.view(shape).mean((1, 3))  # (B, 2)
        doubts = torch.stack([(misses / AGREES).clamp(max=3), support.clamp(min=1e-6).log() / 3, sure], -1)  # (B, 2, 3)
        return points, doubts

    def _look_again(
        self,
        pictures: Tensor,
        projection: Tensor,
        points: Tensor,
        grips: Tensor,
        labels: Keyframes | None,
        jitter: float,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Points (B, 2, 3) corrected, without gradient; orientations (B, 2, 6); the loss of the second look, ()."""
        assert self.zoom is not None
        if self.training and labels is not None:  # what the maps find on training scenes is too good
            points = labels.position + self.settings.displaced * torch.randn_like(points)
        closer = self.zoom(pictures, projection, points, self._normalised(points), grips, jitter)
        miss = points.new_zeros(())
        if labels is not None:
            wanted = (labels.position - points) / self.settings.displaced  # (B, 2, 3)
            miss = functional.smooth_l1_loss(closer.correction, wanted, beta=0.25)
        return points + self.settings.displaced * closer.correction.detach(), closer.axes, miss

    def _axes(self, features: Tensor, window: Tensor, cameras: int) -> Tensor:
        """Orientations (B, 2, 6), read where the first camera's maps are high."""
        assert self.axes is not None
        around = window[::cameras].flatten(2) @ features[::cameras].flatten(2).transpose(1, 2)  # (B, 4, C)
        axes: Tensor = self.axes(around.unflatten(1, (ARMS, POINTS)).flatten(2))
        return axes

    def _normalised(self, points: Tensor) -> Tensor:
        return (points - self.centre) / self.spread  # (B, 2, 3)

    def _with_feet(self, points: Tensor) -> Tensor:
        """Tools (B, 2, 3) and their feet on the table, (B, 2, 2, 3)."""
        feet = points * points.new_tensor([1, 1, 0]) + points.new_tensor([0, 0, self.settings.table_height])
        return torch.stack([points, feet], dim=2)

    def solve(self, places: Tensor, weight: Tensor, projection: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The point of each arm that all rays agree on best; rays that do not agree lose their weight.

        A ray through the tool passes the point itself, one through its foot passes the point below it on the table.

        Args:
            places: (B, V, 2, 2, 2) peaks of tool and foot in image units.
            weight: (B, V, 2, 2) how sure each is.
            projection: (B, V, 3, 4).

        Returns:
            (B, 2, 3) points in m, (B, 2) how far rays miss them in image units, (B, 2) weight that is left.
        """
        origin, ray, focal = rays(places.float(), projection.float())  # (B, V, 3), (B, V, 2, 2, 3), (B, V)
        identity = torch.eye(3, device=ray.device)
        across = identity - ray[..., :, None] * ray[..., None, :]  # (B, V, 2, 2, 3, 3), what is beside the ray
        flat = ray.new_tensor([1, 1, 0])
        keep = torch.stack([identity, torch.diag(flat)])  # (2, 3, 3): of a point; of its foot
        table = (1 - flat) * self.settings.table_height
        offset = torch.stack([torch.zeros_like(table), table])[:, None, :] - origin[:, :, None, None, None]
        offset = offset[..., 0, :]  # (B, V, 1, 2, 3), from the camera to the table's part of a foot
        normal = keep @ across @ keep  # (B, V, 2, 2, 3, 3)
        pull = -(keep @ across @ offset[..., None]).squeeze(-1)  # (B, V, 2, 2, 3)
        distance = torch.full_like(weight, 0.7)  # m, of a table from a camera, until there is a first solution
        trust = torch.ones_like(weight)
        held = 1.5e-3  # keeps a point that no camera sees where keyframes usually are
        for turn in range(4):
            strength = trust * (weight * focal[:, :, None, None] / distance).square()  # (B, V, 2, 2)
            left = (strength[..., None, None] * normal).sum((1, 3)) + held * identity  # (B, 2, 3, 3)
            right = (strength[..., None] * pull).sum((1, 3)) + held * self.centre  # (B, 2, 3)
            points = (inverse_matrix(left) @ right[..., None]).squeeze(-1)  # (B, 2, 3)
            view = (keep @ points[:, None, :, None, :, None]).squeeze(-1) + offset  # (B, V, 2, 2, 3), camera to point
            distance = view.norm(dim=-1).clamp(min=0.05)
            beside = (across @ view[..., None]).squeeze(-1).norm(dim=-1)  # (B, V, 2, 2) m
            misses = beside * focal[:, :, None, None] / distance  # in image units
            if turn:
                trust = (1 + (misses / AGREES).square()).square().reciprocal()
        support = strength.sum((1, 3))  # (B, 2)
        return points, (strength * misses).sum((1, 3)) / support.clamp(min=1e-9), support

    def _features(self, stages: tuple[Tensor, Tensor, Tensor], cameras: int, grips: Tensor) -> Tensor:
        """One map of features (B V, C, h, w) from three resolutions."""
        x: Tensor | None = None
        for lateral, stage in reversed(list(zip(self.laterals, stages, strict=True))):
            coarser = 0 if x is None else functional.interpolate(x, size=stage.shape[2:], mode="nearest")
            x = lateral(stage) + coarser
        assert x is not None
        told = self.camera_embed  # (V, C)
        if self.grips is not None:
            told = told + self.grips(grips)[:, None]  # (B, V, C)
        x = functional.relu(x.unflatten(0, (-1, cameras)) + told[..., None, None].to(x.dtype)).flatten(0, 1)
        x = functional.relu(self.smooth(x))
        for layer in self.context:
            x = x + functional.relu(layer(x))
        return x

    def _chances(self, features: Tensor) -> Tensor:
        """Log-probabilities of each map's cells, and of `not in this picture` behind them, (B V, 4, h w + 1)."""
        pooled = torch.cat([features.mean((2, 3)), features.amax((2, 3))], dim=1)  # (B V, 2 C)
        absent = self.absent(pooled).float()[..., None] + SHY  # (B V, 4, 1)
        return torch.cat([self.maps(features).float().flatten(2), absent], dim=-1).log_softmax(-1)

    def _map_terms(
        self,
        chances: Tensor,
        place: Tensor,
        shift: Tensor,
        projection: Tensor,
        labels: Keyframes,
        cells: torch.Size,
        pixels: torch.Size,
    ) -> tuple[Tensor, Tensor]:
        """The maps' cross-entropy against the true cells, and for the log their error in pixels of the first camera."""
        target, inside = project(self._with_feet(labels.position), projection)  # (B, V, 2, 2, 2), (B, V, 2, 2)
        target = target.flatten(0, 1).flatten(1, 2) - shift[:, None]  # (B V, 4, 2), in the moved picture
        inside = inside.flatten(0, 1).flatten(1, 2) & (target.abs().amax(-1) < 1)  # (B V, 4)
        told = cross_entropy(chances, target, inside, cells)  # (B V, 4)
        scale = target.new_tensor([pixels[1], pixels[0]]) / 2
        error = ((place - target) * scale).norm(dim=-1).detach()  # (B V, 4)
        first = torch.zeros_like(inside)
        first[:: projection.shape[1]] = True
        median = error.where(inside & first, torch.nan).nanmedian().nan_to_num()
        return told.mean(), median


def project(points: Tensor, projection: Tensor) -> tuple[Tensor, Tensor]:
    """Where points of the world are in every picture.

    Args:
        points: (B, 2, 2, 3) m.
        projection: (B, V, 3, 4).

    Returns:
        (B, V, 2, 2, 2) u, v in image units, and (B, V, 2, 2) whether they are inside the picture.
    """
    matrix, offset = projection[:, :, None, None, :, :3], projection[:, :, None, None, :, 3]
    seen = (matrix @ points[:, None, ..., None]).squeeze(-1) + offset  # (B, V, 2, 2, 3)
    depth = seen[..., 2]
    place = seen[..., :2] / depth.clamp(min=1e-6)[..., None]
    return place, (depth > NEAR) & (place.abs().amax(-1) < 1)


def cross_entropy(chances: Tensor, target: Tensor, inside: Tensor, size: Sequence[int]) -> Tensor:
    """Negative log-likelihood of the cells around each target, by how near they are; of absence where it is outside.

    Args:
        chances: (n, m, h w + 1) log-probabilities.
        target: (n, m, 2) u, v in image units.
        inside: (n, m) bool.
        size: h, w.

    Returns:
        (n, m).
    """
    height, width = size
    limit = target.new_tensor([width, height]) - 1
    cell = ((target + 1) / 2 * (limit + 1) - 0.5).clamp(min=target.new_zeros(2), max=limit)  # (n, m, 2)
    low = cell.floor()
    share = cell - low  # (n, m, 2)
    told = torch.zeros_like(share[..., 0])
    for dx in (0, 1):
        for dy in (0, 1):
            x, y = ((low + low.new_tensor([dx, dy])).clamp(max=limit)).long().unbind(-1)
            part = (share[..., 0] if dx else 1 - share[..., 0]) * (share[..., 1] if dy else 1 - share[..., 1])
            told = told - part * chances.gather(2, (y * width + x)[..., None])[..., 0]
    return torch.where(inside, told, -chances[..., -1])


def peak(chance: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The highest place of each map: the mean position within two cells of the highest cell.

    Args:
        chance: (n, m, h, w) float32, probabilities.

    Returns:
        (n, m, 2) u, v in image units, (n, m) the probability around it, (n, m, h, w) shares of that, without gradient.
    """
    height, width = chance.shape[2:]
    best = chance.flatten(2).argmax(-1)[..., None, None]  # (n, m, 1, 1)
    row = torch.arange(height, device=chance.device)[:, None]
    column = torch.arange(width, device=chance.device)
    near = ((row - best // width).abs() <= 2) & ((column - best % width).abs() <= 2)  # (n, m, h, w)
    part = chance * near
    mass = part.sum((2, 3)).clamp(min=1e-6)  # (n, m)
    u = (part.sum(2) * ((column + 0.5) / width * 2 - 1)).sum(-1) / mass
    v = (part.sum(3) * ((row[:, 0] + 0.5) / height * 2 - 1)).sum(-1) / mass
    return torch.stack([u, v], -1), mass, (part / mass[..., None, None]).detach()


def rays(places: Tensor, projection: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The straight line of everything that is seen at a place of a picture.

    Args:
        places: (B, V, 2, 2, 2) u, v in image units.
        projection: (B, V, 3, 4).

    Returns:
        (B, V, 3) where the cameras are, (B, V, 2, 2, 3) unit directions, (B, V) focal length in image units.
    """
    back = inverse_matrix(projection[..., :3])  # (B, V, 3, 3)
    origin = -(back @ projection[..., 3:]).squeeze(-1)
    ahead = torch.cat([places, torch.ones_like(places[..., :1])], -1)[..., None]  # (B, V, 2, 2, 3, 1)
    direction = (back[:, :, None, None] @ ahead).squeeze(-1)
    across = back[..., 0]  # what one image unit to the right is at a depth of 1 m
    return origin, direction / direction.norm(dim=-1, keepdim=True), across.norm(dim=-1).reciprocal()


def inverse_matrix(matrix: Tensor) -> Tensor:
    """The inverse of (..., 3, 3) matrices, in operations that every export format knows."""
    a, b, c = matrix.unbind(-2)
    columns = torch.stack([torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)], -1)
    return columns / (a * columns[..., 0]).sum(-1)[..., None, None]


def missing_keyframes(got: str) -> ConfigError:
    """The error of a policy that looks for keyframes and has nothing to find them with.

    Args:
        got: what is missing.
    """
    expected = "tool poses and calibrated cameras (`endpose`, `intrinsic_cv`, `extrinsic_cv` of RoboTwin's files)"
    fix = "Give observations and data that have both, or set the policy's `keyframes` to null."
    return ConfigError("keyframes", expected, got, fix)

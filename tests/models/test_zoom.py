"""A second look around what the maps have found."""

import pytest
import torch
from torch.nn import functional

from ugr_lightning.contract import CAMERAS, Keyframes
from ugr_lightning.errors import ConfigError
from ugr_lightning.models.keyframes import KeyframeFinder, KeyframeSettings
from ugr_lightning.models.mirror import mirror_batch
from ugr_lightning.models.zoom import FARTHEST, Zoom, crop

HEIGHT, WIDTH = 24, 32
ABOVE = torch.tensor([[1.0, 0, 0, 0], [0, -4 / 3, 0, 0], [0, 0, -1, 1]])
"""A camera 1 m above the table that sees 2 m by 1.5 m of it (3, 4)."""
SIDEWAYS = torch.tensor([[0.0, 1, 0, 0], [0, 0, -4 / 3, 0.4], [1, 0, 0, 1]])
"""One that looks along x from x = -1 (3, 4)."""


def blobs(points, projection):
    """Pictures (B, V, 3, H, W) that are dark but where the points (B, 2, 3) are: red the left one, green the right."""
    seen = (projection[:, :, None, :, :3] @ points[:, None, ..., None]).squeeze(-1) + projection[:, :, None, :, 3]
    place = (seen[..., :2] / seen[..., 2:] + 1) / 2 * torch.tensor([WIDTH, HEIGHT]) - 0.5  # (B, V, 2, 2) pixels
    rows, columns = torch.arange(HEIGHT)[:, None], torch.arange(WIDTH)
    apart = (columns - place[..., 0, None, None]) ** 2 + (rows - place[..., 1, None, None]) ** 2
    bright = 255 * torch.exp(-apart / 4)  # (B, V, 2, H, W)
    return torch.cat([bright, torch.zeros_like(bright[:, :, :1])], dim=2).to(torch.uint8)


def table(count):
    """Projections (count, 2, 3, 4) and points on the table (count, 2, 3)."""
    points = torch.rand(count, 2, 3) * torch.tensor([1.2, 0.9, 0.2]) - torch.tensor([0.6, 0.45, 0.0])
    return torch.stack([ABOVE, SIDEWAYS]).expand(count, -1, -1, -1), points


def test_a_crop_shows_the_pixels_around_a_point_and_repeats_the_border():
    pictures = torch.arange(HEIGHT * WIDTH, dtype=torch.uint8).view(1, 1, 1, HEIGHT, WIDTH).expand(-1, -1, 3, -1, -1)
    u, v = 20 * 2 / WIDTH - 1, 6 * 2 / HEIGHT - 1  # where pixels 19, 20 and rows 5, 6 meet
    points = torch.tensor([[[u, -v * 3 / 4, 0.0], [1.0, -3 / 4, 0.0], [0.0, 0.0, 2.0]]])
    squares, inside = crop(pictures, ABOVE[None, None], points, 8)
    shown = ((squares + 1) * 127.5).round()
    assert torch.allclose(shown[0, 0, 0], pictures[0, 0, :, 2:10, 16:24].float())
    assert shown[0, 0, 1, 0, 4:, 4:].unique().tolist() == [pictures[0, 0, 0, -1, -1].item()]
    assert inside.tolist() == [[[True, True, False]]]  # the third is behind the camera


def test_a_crop_of_the_next_level_shows_twice_as_much_around_the_same_place():
    pictures = torch.randint(0, 256, (1, 1, 3, HEIGHT, WIDTH), dtype=torch.uint8)
    middle = torch.zeros(1, 1, 3)  # between four pixels of either level
    fine, _ = crop(pictures, ABOVE[None, None], middle, 16)
    coarse, _ = crop(pictures, ABOVE[None, None], middle, 8, level=1)
    assert torch.allclose(coarse[0, 0, 0], functional.avg_pool2d(fine[0, 0, 0], 2), atol=1e-5)


def test_crops_of_a_mirror_image_are_the_mirror_images_of_the_crops(batch):
    _, points = table(3)
    views = torch.stack([ABOVE, SIDEWAYS, ABOVE + 0.1 * SIDEWAYS]).expand(3, -1, -1, -1)
    labels = Keyframes(points, torch.zeros(3, 2, 6), torch.ones(3, 2, dtype=torch.long))
    samples = batch._replace(projection=views, keyframes=labels)
    turned = mirror_batch(samples, torch.tensor([True, False, True]), CAMERAS)
    (before, near), (after, still) = (
        crop(one.images, one.projection, one.keyframes.position, 16) for one in (samples, turned)
    )
    assert near[::2].float().mean() > 0.5
    assert torch.equal(after[1], before[1])
    assert torch.equal(still[::2], near[::2, [0, 2, 1]].flip(2))
    expected = before[::2, [0, 2, 1]].flip(2).flip(-1)  # the wrists change places, and so do the arms
    assert torch.allclose(after[::2][still[::2]], expected[still[::2]], atol=1e-4)


@pytest.mark.parametrize("levels", [1, 2])
def test_it_learns_to_say_from_the_pictures_how_far_off_a_point_is(levels, monkeypatch):
    monkeypatch.setattr("ugr_lightning.models.zoom.CHANNELS", 8)
    torch.manual_seed(0)
    zoom = Zoom(16, 2, 6, levels)
    optimiser = torch.optim.Adam(zoom.parameters(), 3e-3)
    for _ in range(150):
        projection, points = table(32)
        off = 0.08 * torch.randn_like(points)
        answer = zoom(blobs(points, projection), projection, points + off, points + off, torch.zeros(32, 2))
        loss = (answer.correction + off / 0.08).abs().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    projection, points = table(200)
    off = 0.08 * torch.randn_like(points)
    zoom.eval()
    answer = zoom(blobs(points, projection), projection, points + off, points + off, torch.zeros(200, 2))
    left = off + 0.08 * answer.correction
    assert left.square().mean().sqrt() < 0.4 * off.square().mean().sqrt()


def test_what_it_has_learned_to_correct_limits_a_correction_outside_training():
    torch.manual_seed(0)
    zoom, (projection, points) = Zoom(8, 2, 6), table(2)
    for hand in zoom.hands:
        torch.nn.init.constant_(hand[-1].bias, 100.0)
    arguments = (blobs(points, projection), projection, points, points, torch.zeros(2, 2))
    assert zoom.train()(*arguments).correction.min() > 90
    assert zoom.eval()(*arguments).correction.unique().tolist() == [FARTHEST]


def test_outside_training_it_starts_from_what_the_maps_found_and_labels_change_nothing():
    torch.manual_seed(0)
    projection, points = table(2)
    finder = KeyframeFinder(KeyframeSettings(channels=8, zoom=8), (8, 16, 32), 2).eval()
    stages = (torch.rand(4, 8, 6, 8), torch.rand(4, 16, 3, 4), torch.rand(4, 32, 2, 2))
    asked = (stages, projection, torch.zeros(4, 2), torch.zeros(2, 2), blobs(points, projection))
    labels = Keyframes(points, torch.zeros(2, 2, 6), torch.ones(2, 2, dtype=torch.long))
    assert torch.equal(finder(*asked).points, finder(*asked, labels).points)
    finder.train()
    assert not torch.allclose(finder(*asked).points, finder(*asked, labels).points)


def test_the_correction_moves_what_the_maps_found_and_its_axes_are_told():
    torch.manual_seed(0)
    projection, points = table(2)
    finder = KeyframeFinder(KeyframeSettings(channels=8, zoom=8, displaced=0.01), (8, 16, 32), 2).eval()
    stages = (torch.rand(4, 8, 6, 8), torch.rand(4, 16, 3, 4), torch.rand(4, 32, 2, 2))
    asked = (stages, projection, torch.zeros(4, 2), torch.zeros(2, 2), blobs(points, projection))
    answers = torch.tensor([[0.0, 0, 0, 1, 0, 0, 0, 1, 0], [2.0, 0, -1, 0, 1, 0, 0, 0, 1]])
    found = []
    for answer in answers:
        for hand in finder.zoom.hands:
            torch.nn.init.zeros_(hand[-1].weight)
            hand[-1].bias.data.copy_(answer)
        found.append(finder(*asked))
    moved = (found[1].points - found[0].points)[:, :, 0]  # (2, 2, 3) of the tools
    assert torch.allclose(moved, torch.tensor([0.02, 0, -0.01]).expand(2, 2, -1), atol=1e-6)
    told = found[1].features.unflatten(1, (2, -1))
    assert torch.equal(told[..., -6:], answers[1, 3:].expand(2, 2, -1))


@pytest.mark.parametrize("side", [30, -8, 1000])
def test_a_crop_is_cut_into_eighths_and_smaller_than_a_picture(side):
    with pytest.raises(ConfigError, match="multiple of 8 pixels, at most 128"):
        KeyframeSettings(zoom=side)


def test_each_level_of_each_camera_has_eyes_of_its_own():
    finder = KeyframeFinder(KeyframeSettings(channels=8, zoom=8, zoom_levels=3), (8, 16, 32), 2)
    assert len(finder.zoom.eyes) == 6


@pytest.mark.parametrize("levels", [1, 2])
def test_the_second_level_sees_what_is_outside_the_first(levels):
    torch.manual_seed(0)
    zoom = Zoom(8, 1, 6, levels).eval()
    dark, place = torch.zeros(1, 1, 3, HEIGHT, WIDTH, dtype=torch.uint8), torch.zeros(1, 2, 3)
    bright_around = torch.full_like(dark, 255)
    bright_around[..., HEIGHT // 2 - 5 : HEIGHT // 2 + 5, WIDTH // 2 - 5 : WIDTH // 2 + 5] = 0
    answers = [zoom(seen, ABOVE[None, None], place, place, torch.zeros(1, 2)).axes for seen in (dark, bright_around)]
    assert torch.equal(*answers) == (levels == 1)


def test_levels_are_few():
    with pytest.raises(ConfigError, match=r"keyframes\.zoom_levels: expected 1 to 4"):
        KeyframeSettings(zoom=8, zoom_levels=0)


@pytest.mark.parametrize("displaced", [0.0, -0.015, float("nan"), float("inf")])
def test_a_displacement_is_a_distance(displaced):
    with pytest.raises(ConfigError, match=r"keyframes\.displaced: expected a distance"):
        KeyframeSettings(zoom=8, displaced=displaced)

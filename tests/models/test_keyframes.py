"""Where each hand will grip next."""

import pytest
import torch
from deployed import tiny_act

from ugr_lightning.contract import CAMERAS, Keyframes, Observation, Statistics
from ugr_lightning.embodiment import image_projection
from ugr_lightning.errors import ConfigError
from ugr_lightning.models.act import ACT
from ugr_lightning.models.diffusion import DiffusionPolicy
from ugr_lightning.models.keyframes import KeyframeFinder, KeyframeSettings, cross_entropy, peak, project
from ugr_lightning.models.mirror import mirror_batch, mirror_joints, mirrored_statistics

HEIGHT, WIDTH = 48, 64
GRIPS = torch.zeros(2, 2)
DARK = torch.zeros(2, 3, 3, HEIGHT, WIDTH, dtype=torch.uint8)


def looking(eye, target):
    """OpenCV's world-to-camera matrix (3, 4) of a camera at `eye` that looks at `target`, the world's z upwards."""
    eye, target = torch.tensor(eye), torch.tensor(target)
    ahead = torch.nn.functional.normalize(target - eye, dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(ahead, torch.tensor([0.0, 0.0, 1.0])), dim=0)
    rotation = torch.stack([right, torch.linalg.cross(ahead, right), ahead])  # (3, 3)
    return torch.cat([rotation, -(rotation @ eye)[:, None]], dim=1)


@pytest.fixture
def projection():
    """Three cameras around a table, twice (2, 3, 3, 4)."""
    intrinsic = torch.tensor([[50.0, 0, WIDTH / 2], [0, 50.0, HEIGHT / 2], [0, 0, 1]]).numpy()
    eyes = ([0.0, -0.6, 0.8], [0.5, 0.1, 0.4], [-0.5, 0.1, 0.4])
    views = [image_projection(intrinsic, looking(eye, [0.0, 0.05, 0.05]).numpy(), (HEIGHT, WIDTH)) for eye in eyes]
    return torch.stack([torch.from_numpy(view) for view in views]).expand(2, -1, -1, -1)


@pytest.fixture
def keyframes():
    generator = torch.Generator().manual_seed(0)
    position = torch.tensor([[-0.15, 0.05, 0.12], [0.15, 0.0, 0.1]]) + 0.04 * torch.randn(2, 2, 3, generator=generator)
    return Keyframes(position, torch.tensor([1.0, 0, 0, 0, 1, 0]).expand(2, 2, -1), torch.full((2, 2), 7))


@pytest.fixture
def finder(keyframes):
    torch.manual_seed(0)
    built = KeyframeFinder(KeyframeSettings(channels=16), (8, 16, 32), 3)
    built.centre.copy_(keyframes.position.mean(0))
    return built


@pytest.fixture
def seen(batch, projection, keyframes, statistics):
    """Two samples with everything that keyframes need, and statistics."""
    images = torch.zeros(2, 3, HEIGHT, WIDTH, 3, dtype=torch.uint8).random_(generator=torch.Generator().manual_seed(3))
    known = statistics._replace(keyframe_mean=keyframes.position.mean(0), keyframe_std=torch.full((2, 3), 0.05))
    samples = batch._replace(
        **{name: getattr(batch, name)[:2] for name in ("state", "actions", "valid", "episode", "step")},
        images=images.permute(0, 1, 4, 2, 3),
        projection=projection,
        keyframes=keyframes,
    )
    return samples, known


def places_of(keyframes, projection):
    foot = keyframes.position * torch.tensor([1, 1, 0])
    return project(torch.stack([keyframes.position, foot], dim=2), projection)


def test_a_point_is_projected_to_where_opencv_sees_it():
    intrinsic = torch.tensor([[50.0, 0, 30], [0, 40.0, 20], [0, 0, 1]]).numpy()
    extrinsic = looking([0.1, -0.6, 0.8], [0.0, 0.0, 0.0]).numpy()
    matrix = image_projection(intrinsic, extrinsic, (HEIGHT, WIDTH))
    pixel = intrinsic @ (extrinsic @ [0.05, 0.02, 0.1, 1.0])
    u, v = pixel[:2] / pixel[2]
    image = matrix @ [0.05, 0.02, 0.1, 1.0]
    assert (image[:2] / image[2]).tolist() == pytest.approx([2 * u / WIDTH - 1, 2 * v / HEIGHT - 1], abs=1e-5)
    assert image[2] == pytest.approx(pixel[2], abs=1e-6)


def test_rays_through_the_true_pixels_meet_in_the_point(finder, projection, keyframes):
    places, inside = places_of(keyframes, projection)
    points, misses, _ = finder.solve(places, inside.float(), projection)
    assert (points - keyframes.position).norm(dim=-1).max() < 5e-4
    assert misses.max() < 1e-3


def test_one_camera_that_is_wrong_is_outvoted(finder, projection, keyframes):
    places, inside = places_of(keyframes, projection)
    wrong = places.clone()
    wrong[:, 0] += 0.5
    points, _, support = finder.solve(wrong, inside.float(), projection)
    _, _, full = finder.solve(places, inside.float(), projection)
    assert (points - keyframes.position).norm(dim=-1).max() < 0.01
    assert (support < full).all()


def test_a_point_that_no_camera_sees_is_where_keyframes_usually_are(finder, projection, keyframes):
    places, inside = places_of(keyframes, projection)
    points, _, support = finder.solve(places, torch.zeros_like(inside, dtype=torch.float), projection)
    assert torch.allclose(points, finder.centre.expand_as(points), atol=1e-5)
    assert support.max() == 0


def test_the_loss_is_least_where_the_map_says_what_is_true():
    target, inside = torch.tensor([[[0.3, -0.2], [0.9, 0.9]]]), torch.tensor([[True, False]])
    logits = torch.zeros(1, 2, 12 * 16 + 1)
    cell = int((-0.2 + 1) / 2 * 12) * 16 + int((0.3 + 1) / 2 * 16)
    even = cross_entropy(logits.log_softmax(-1), target, inside, (12, 16))
    logits[0, 0, cell] = logits[0, 1, -1] = 9.0
    told = cross_entropy(logits.log_softmax(-1), target, inside, (12, 16))
    assert (told < even).all()
    assert told[0, 1] < 0.1  # not in this picture


def test_the_peak_is_read_between_cells_and_ignores_a_second_one_far_away():
    chance = torch.zeros(1, 1, 12, 16)
    chance[0, 0, 5, 7], chance[0, 0, 5, 8], chance[0, 0, 0, 0] = 0.4, 0.35, 0.25
    place, mass, share = peak(chance)
    assert place[0, 0].tolist() == pytest.approx([(7.5 * 0.4 + 8.5 * 0.35) / 0.75 / 8 - 1, 5.5 / 6 - 1], abs=1e-5)
    assert mass.item() == pytest.approx(0.75)
    assert share.sum().item() == pytest.approx(1)


def test_maps_learn_a_place_and_moving_the_picture_moves_the_label(finder, projection, keyframes):
    """Features that mark the true cell; the picture is moved by two cells, and what is found is not."""
    places, _ = places_of(keyframes, projection)
    shift = torch.tensor([4 / 16, -4 / 12]).expand(6, -1)
    moved = places.flatten(0, 1) - shift[:, None, None]  # (6, 2, 2, 2)
    first = torch.zeros(6, 8, 12, 16)
    for view in range(6):
        for point, (u, v) in enumerate(moved[view].flatten(0, 1)):
            if max(abs(u), abs(v)) < 1:
                first[view, point, int((v + 1) * 6), int((u + 1) * 8)] = 1.0
    stages = (first, torch.zeros(6, 16, 6, 8), torch.zeros(6, 32, 3, 4))
    optimiser = torch.optim.Adam(finder.parameters(), 1e-2)
    for _ in range(120):
        finder.train()
        terms = finder(stages, projection, shift, GRIPS, DARK, keyframes).terms
        optimiser.zero_grad()
        terms["keyframe"].backward()
        optimiser.step()
    found = finder.eval()(stages, projection, shift, GRIPS, DARK, keyframes)
    assert found.terms["keyframe_px"] < 4  # a cell
    finer = finder(stages, projection, shift, GRIPS, DARK.repeat(1, 1, 1, 2, 2), keyframes)
    assert finer.terms["keyframe_px"] == 2 * found.terms["keyframe_px"] > 0
    expected, inside = places_of(keyframes, projection)
    seen = inside & (moved.unflatten(0, (2, 3)).abs().amax(-1) < 1)
    place, _, _ = peak(found.maps.flatten(0, 1).flatten(1, 2))  # (6, 4, 2)
    assert (place + shift[:, None] - expected.flatten(0, 1).flatten(1, 2))[
        seen.flatten(0, 1).flatten(1)
    ].abs().max() < 0.2


@pytest.mark.parametrize("grips", [True, False])
def test_the_same_pictures_mean_another_place_once_a_gripper_has_let_go(projection, keyframes, grips):
    torch.manual_seed(0)
    finder = KeyframeFinder(KeyframeSettings(channels=16, grips=grips), (8, 16, 32), 3)
    finder.centre.copy_(keyframes.position.mean(0))
    after = keyframes._replace(position=keyframes.position + torch.tensor([0.0, 0.12, 0.0]))
    stages = (torch.rand(1, 8, 12, 16), torch.rand(1, 16, 6, 8), torch.rand(1, 32, 3, 4))
    stages = tuple(stage.expand(6, -1, -1, -1) for stage in stages)
    shift, closed, opened = torch.zeros(6, 2), torch.zeros(2, 2), torch.ones(2, 2)
    optimiser = torch.optim.Adam(finder.parameters(), 1e-2)
    for _ in range(100):
        optimiser.zero_grad()
        for grip, labels in ((closed, keyframes), (opened, after)):
            finder(stages, projection, shift, grip, DARK, labels).terms["keyframe"].backward()
        optimiser.step()
    errors = [
        finder(stages, projection, shift, grip, DARK, labels).terms["keyframe_px"].item()
        for grip, labels in ((closed, keyframes), (opened, after))
    ]
    assert (max(errors) < 2) == grips


def test_with_context_a_cell_sees_farther_around(projection):
    reach = {}
    for context in ((), (2, 4)):
        torch.manual_seed(0)
        finder = KeyframeFinder(KeyframeSettings(channels=16, context=context), (8, 16, 32), 3)
        first = torch.rand(3, 8, 24, 32, requires_grad=True)
        features = finder._features((first, torch.rand(3, 16, 12, 16), torch.rand(3, 32, 6, 8)), 3, GRIPS[:1])
        features[0, :, 12, 16].sum().backward()
        rows = first.grad[0].abs().sum((0, 2)).nonzero().squeeze(1)
        reach[context] = (rows.max() - rows.min() + 1).item()
    assert reach == {(): 3, (2, 4): 3 + 2 * 2 + 2 * 4}


@pytest.mark.parametrize("zoom", [0, 16])
@pytest.mark.parametrize("kind", ["act", "diffusion"])
def test_a_policy_learns_with_keyframes_and_refuses_observations_without_calibration(tiny, seen, kind, zoom):
    samples, statistics = seen
    looks = KeyframeSettings(channels=8, context=(2,), grips=True, zoom=zoom)
    settings = {"keyframes": looks, "mirror": 0.5, "image_dropout": 0.4, "state_dropout": 0.3}
    if kind != "diffusion":
        policy = tiny(backbone_stem="unshuffle", keypoints=2, image_shift=4, **settings)
    else:
        sizes = {"unet_widths": (8, 16), "backbone_width": 8, "precision": "fp32"}
        policy = DiffusionPolicy(CAMERAS, 10, 1, False, **sizes, **settings)
    policy.set_statistics(statistics)
    terms = policy.train().losses(samples)
    terms["loss"].backward()
    assert {"keyframe", "keyframe_px", "keyframe_mm"} <= set(terms)
    assert [name for name, parameter in policy.named_parameters() if parameter.grad is None] == []
    chunk = policy.predict(samples.observation)
    assert chunk.maps.shape[:4] == (2, 3, 2, 2)
    assert (chunk.maps.sum((-2, -1)) <= 1 + 1e-5).all()
    assert torch.equal(chunk.points[:, :, 0, :2], chunk.points[:, :, 1, :2])  # a foot is below its tool
    assert (chunk.points[:, :, 1, 2] == 0).all()
    fast = policy.for_inference().predict(samples.observation)
    assert torch.allclose(chunk.actions, fast.actions, atol=1e-3)
    with pytest.raises(ConfigError, match="calibrated cameras"):
        policy.predict(Observation(samples.images, samples.state))
    with pytest.raises(ConfigError, match="tool poses"):
        policy.set_statistics(statistics._replace(keyframe_mean=None))


def test_image_features_and_joints_are_never_hidden_together(tiny):
    policy = tiny(state_dropout=0.3, image_dropout=0.4).train()
    state, blind = policy.disturb(torch.ones(4000, 14))
    hidden = state.abs().sum(1) == 0
    assert not (hidden & blind).any()
    assert hidden.float().mean().item() == pytest.approx(0.3, abs=0.03)
    assert blind.float().mean().item() == pytest.approx(0.4, abs=0.03)
    with pytest.raises(ConfigError, match="at most 1"):
        ACT(state_dropout=0.7, image_dropout=0.5)


def test_a_mirror_image_of_a_mirror_image_is_the_sample_itself(seen):
    samples, statistics = seen
    cameras = CAMERAS
    both = torch.tensor([True, False])
    once = mirror_batch(samples, both, cameras)
    assert torch.equal(once.images[0, 1], samples.images[0, 2].flip(-1))
    assert torch.equal(once.images[1], samples.images[1])
    again = mirror_batch(once, both, cameras)
    for one, other in zip([*again[:7], *again.keyframes], [*samples[:7], *samples.keyframes], strict=True):
        assert torch.allclose(one.float(), other.float())
    twice = mirrored_statistics(mirrored_statistics(statistics))
    assert torch.allclose(twice.state_std, mirrored_statistics(statistics).state_std)


@pytest.mark.parametrize(
    ("robot", "said"),
    [
        ({"state_dim": 16, "action_dim": 16}, "14 numbers.*16 and 16"),
        ({"action_dim": 7}, "14 numbers.*14 and 7"),
        ({"cameras": ("cam_high", "cam_left_wrist")}, "cam_right_wrist beside cam_left_wrist"),
    ],
)
def test_a_robot_of_which_no_mirror_image_is_known_is_refused(robot, said):
    with pytest.raises(ConfigError, match=f"^mirror: .*{said}"):
        tiny_act(fitted=False, mirror=0.5, **robot)
    assert tiny_act(fitted=False, **robot).mirror == 0


def test_mirrored_cameras_see_mirrored_keyframes_at_the_mirrored_place(seen):
    samples, _ = seen
    once = mirror_batch(samples, torch.tensor([True, True]), CAMERAS)
    before, _ = places_of(samples.keyframes, samples.projection)
    after, _ = places_of(once.keyframes, once.projection)
    swapped = before[:, [0, 2, 1]].flip(2) * torch.tensor([-1.0, 1.0])
    assert torch.allclose(after, swapped, atol=1e-4)


def test_statistics_of_mirrored_data_are_those_of_data_and_mirror_image_together():
    rows = torch.randn(500, 14, generator=torch.Generator().manual_seed(0)) * torch.arange(1, 15) + 3
    both = torch.cat([rows, mirror_joints(rows)])
    parts = [rows.mean(0), rows.std(0, correction=0), rows.amin(0), rows.amax(0)]
    found = mirrored_statistics(Statistics(*parts, *parts))
    expected = [both.mean(0), both.std(0, correction=0), both.amin(0), both.amax(0)]
    for have, want in zip(found[:4], expected, strict=True):
        assert torch.allclose(have, want, atol=1e-4)

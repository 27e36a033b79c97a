"""Diffusion Policy: its size, its promises, and that it learns what an average cannot say."""

from collections.abc import Callable
from typing import Any

import pytest
import torch

from ugr_lightning.blueprint import rebuild
from ugr_lightning.contract import Batch, Observation, Statistics
from ugr_lightning.errors import CheckpointError, ConfigError, NumericsError
from ugr_lightning.models.diffusion import DiffusionPolicy

CAMERAS = ["cam_high", "cam_right_wrist", "cam_left_wrist"]
TINY: dict[str, Any] = {
    "cameras": CAMERAS,
    "chunk_length": 10,
    "observation_steps": 1,
    "predict_past": False,
    "diffusion_steps": 20,
    "sampler": "ddim",
    "sampling_steps": 4,
    "unet_widths": [16, 32],
    "backbone_width": 8,
    "precision": "fp32",
}
HISTORY = {"observation_steps": 3, "predict_past": True, "cameras": ["cam_high"]}
COMPACT = {
    "share_backbone": True,
    "backbone_stem": "unshuffle",
    "backbone_norm": "batch",
    "keypoints": 4,
    "state_dropout": 0.5,
    "image_shift": 2,
    "noise_draws": 2,
}
variants = pytest.mark.parametrize("changes", [{}, COMPACT, HISTORY], ids=["plain", "compact", "history"])


@pytest.fixture
def tiny_dp(statistics: Statistics) -> Callable[..., DiffusionPolicy]:
    def build(**changes: Any) -> DiffusionPolicy:
        torch.manual_seed(0)
        policy = DiffusionPolicy(**{**TINY, **changes})
        policy.set_statistics(statistics)
        return policy

    return build


def seen_by(policy: DiffusionPolicy, batch: Batch) -> Batch:
    """The batch with the cameras and the history of a policy; earlier observations differ from the newest."""
    images, state = batch.images[:, : len(policy.cameras)], batch.state
    if policy.observation_steps > 1:
        ages = range(policy.observation_steps - 1, -1, -1)
        images = torch.stack([images.roll(age, -1) for age in ages], dim=1)
        state = torch.stack([state - 0.1 * age for age in ages], dim=1)
    return batch._replace(images=images, state=state)


def test_robotwins_sizes_have_the_parameters_of_its_public_code():
    with torch.device("meta"):
        policy = DiffusionPolicy()
    count = {name: sum(p.numel() for p in part.parameters()) for name, part in policy.named_children()}
    assert count == {"normalizer": 0, "backbones": 11_176_512, "keypoint_maps": 0, "unet": 85_624_718}
    assert policy.past + policy.chunk_length == 8


@variants
def test_every_parameter_gets_a_gradient(tiny_dp, batch, changes):
    policy = tiny_dp(**changes)
    terms = policy.losses(seen_by(policy, batch))
    assert set(terms) == {"loss"}
    assert terms["loss"].dtype == torch.float32
    terms["loss"].backward()
    assert [name for name, p in policy.named_parameters() if p.grad is None] == []


@variants
def test_prediction_has_the_shape_of_the_contract_and_repeats_itself(tiny_dp, batch, changes):
    policy = tiny_dp(**changes).train()
    observation = seen_by(policy, batch).observation
    before = torch.get_rng_state()
    first = policy.predict(observation)
    assert first.actions.shape == (3, 10, 14)
    assert first.actions.dtype == torch.float32
    assert first.coarse is first.log_variance is first.refined is None
    assert torch.equal(policy.predict(observation).actions, first.actions)
    assert torch.equal(torch.get_rng_state(), before)
    assert policy.training


@pytest.mark.parametrize("sampler", ["ddim", "ddpm"])
def test_a_chunk_does_not_depend_on_what_is_asked_beside_it(tiny_dp, batch, sampler):
    policy = tiny_dp(sampler=sampler, prediction="sample")
    together = policy.predict(batch.observation).actions
    for row in range(3):
        alone = policy.predict(Observation(batch.images[row : row + 1], batch.state[row : row + 1])).actions
        assert torch.allclose(alone[0], together[row], atol=1e-4)


def test_another_seed_draws_another_chunk(tiny_dp, batch):
    policy = tiny_dp()
    one, other = (policy.sample(batch.observation, seed).actions for seed in (0, 1))
    assert torch.equal(one, policy.predict(batch.observation).actions)
    assert (one - other).abs().max() > 0.01


def test_predictions_stay_within_the_range_of_the_training_actions(tiny_dp, batch, statistics):
    actions = tiny_dp().predict(batch.observation).actions
    assert (actions >= statistics.action_min - 1e-4).all()
    assert (actions <= statistics.action_max + 1e-4).all()


def test_validation_has_no_randomness_and_does_not_depend_on_the_batches(tiny_dp, batch):
    policy = tiny_dp(noise_draws=2).eval()
    whole = policy.losses(batch)["loss"]
    torch.manual_seed(5)
    assert policy.losses(batch)["loss"] == whole
    parts = [Batch(*(tensor[rows] for tensor in batch[:6])) for rows in (slice(0, 1), slice(1, 3))]
    sums = [policy.losses(part)["loss"] * part.valid.sum() for part in parts]
    assert torch.allclose(sum(sums) / batch.valid.sum(), whole, atol=1e-5)


def test_training_draws_new_noise_every_time(tiny_dp, batch):
    policy = tiny_dp().train()
    assert policy.losses(batch)["loss"] != policy.losses(batch)["loss"]


def test_padded_steps_do_not_enter_the_loss(tiny_dp, batch):
    policy = tiny_dp().eval()
    policy.unet.forward = lambda noisy, step, condition: 0 * noisy
    noise, _ = policy._draw(batch, 10)
    expected = noise.square().mean(-1)[batch.valid].mean()  # a network that says nothing is wrong by the noise
    assert torch.allclose(policy.losses(batch)["loss"], expected)


def test_all_noisy_versions_of_a_chunk_count(tiny_dp, batch):
    policy = tiny_dp(noise_draws=4).eval()
    policy.unet.forward = lambda noisy, step, condition: 0 * noisy
    noise, step = policy._draw(batch, 10)
    assert noise.shape == (12, 10, 14)
    assert len({tuple(row[0].tolist()) for row in noise}) == 12
    assert step.min() >= 0
    assert step.max() < 20
    expected = noise.square().mean(-1)[batch.valid.repeat_interleave(4, 0)].mean()
    assert torch.allclose(policy.losses(batch)["loss"], expected)


def test_the_past_part_of_the_window_is_the_states_before_and_is_not_executed(tiny_dp, batch, statistics):
    policy = tiny_dp(**HISTORY, prediction="sample").eval()
    batch = seen_by(policy, batch)
    wanted = []
    corrupt = policy.process.corrupt

    def watch(clean, noise, step):
        wanted.append(clean)
        return corrupt(clean, noise, step)

    policy.process.corrupt = watch
    policy.losses(batch)
    assert torch.allclose(policy.normalizer.robot_action(wanted[0][:, :2]), batch.state[:, 1:], atol=1e-5)
    assert torch.allclose(policy.normalizer.robot_action(wanted[0][:, 2:]), batch.actions, atol=1e-5)
    policy.unet.forward = lambda noisy, step, condition: wanted[0]
    within = batch.actions.clamp(statistics.action_min, statistics.action_max)
    assert torch.allclose(policy.predict(batch.observation).actions, within, atol=1e-4)


def test_every_observation_of_the_history_matters(tiny_dp, batch):
    policy = tiny_dp(**HISTORY)
    images, state, _ = seen_by(policy, batch).observation
    condition = policy.eval()._condition(Observation(images, state))[0]
    for age in range(3):
        changed = images.clone()
        changed[:, age] = 255 - changed[:, age]
        moved = state.clone()
        moved[:, age] += 0.5
        assert not torch.allclose(policy._condition(Observation(changed, state))[0], condition, atol=1e-3)
        assert not torch.allclose(policy._condition(Observation(images, moved))[0], condition, atol=1e-3)


def test_cameras_are_told_apart_with_one_backbone_and_with_three(tiny_dp, batch):
    for shared, backbones in ((True, 1), (False, 3)):
        policy = tiny_dp(share_backbone=shared).eval()
        assert len(policy.backbones) == backbones
        swapped = batch._replace(images=batch.images.flip(1))
        before, after = (policy._condition(b.observation)[0] for b in (batch, swapped))
        assert not torch.allclose(before, after, atol=1e-3)


def test_with_state_dropout_of_one_the_state_changes_nothing(tiny_dp, batch):
    policy = tiny_dp(state_dropout=1.0)
    moved = batch.observation._replace(state=batch.state + 1)
    assert torch.equal(policy.predict(moved).actions, policy.predict(batch.observation).actions)


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
@variants
def test_the_policy_for_inference_predicts_the_same(tiny_dp, batch, changes, precision):
    policy = tiny_dp(**{**changes, "precision": precision, "prediction": "sample"})
    observation = seen_by(policy, batch).observation
    fast = policy.for_inference()
    difference = (fast.predict(observation).actions - policy.predict(observation).actions).abs().max()
    assert difference < (1e-4 if precision == "fp32" else 0.2)  # of a range of about 6
    assert not any(p.requires_grad for p in fast.parameters())
    assert all(p.requires_grad and p.dtype == torch.float32 for p in policy.parameters())


@variants
def test_a_blueprint_and_a_state_dict_rebuild_the_policy(tiny_dp, batch, changes):
    policy = tiny_dp(**changes)
    again = rebuild(policy.blueprint())
    again.load_state_dict(policy.state_dict())
    observation = seen_by(policy, batch).observation
    assert torch.equal(again.predict(observation).actions, policy.predict(observation).actions)


def test_what_does_not_fit_is_refused_by_name(tiny_dp, batch):
    policy = tiny_dp()
    with pytest.raises(ConfigError, match=r"\(B, 3, 3, H, W\)"):
        policy.losses(batch._replace(images=batch.images[:, :2]))
    with pytest.raises(ConfigError, match=r"\(B, 3, 1, 3, H, W\)"):
        tiny_dp(**HISTORY).predict(batch.observation)
    with pytest.raises(NumericsError, match=r"observation\.state"):
        policy.predict(batch.observation._replace(state=torch.full((3, 14), torch.nan)))
    with pytest.raises(CheckpointError, match="statistics"):
        DiffusionPolicy(**TINY).losses(batch)
    for named, changes in (
        ("observation_steps", {"observation_steps": 0}),
        ("noise_draws", {"noise_draws": 0}),
        ("predict_past", {**HISTORY, "state_dim": 7}),
    ):
        with pytest.raises(ConfigError, match=named):
            tiny_dp(**changes)


def test_it_learns_two_ways_where_an_average_would_be_neither():
    """One picture, two demonstrations: both joints to +0.5 or both to -0.5; neither is the average, 0."""
    torch.manual_seed(0)
    toy = {"cameras": ["cam_high"], "chunk_length": 2, "state_dim": 2, "action_dim": 2, "unet_widths": [32]}
    policy = DiffusionPolicy(**{**TINY, **toy, "noise_draws": 64, "sampling_steps": 20})
    ones = torch.ones(2)
    policy.set_statistics(Statistics(*2 * (0 * ones, ones, -ones, ones)))
    actions = torch.tensor([0.5, -0.5])[:, None, None].expand(2, 2, 2)
    images, none = torch.zeros(2, 1, 3, 8, 8, dtype=torch.uint8), torch.zeros(2, dtype=torch.int64)
    batch = Batch(images, torch.zeros(2, 2), actions, torch.ones(2, 2, dtype=torch.bool), none, none)
    optimizer = torch.optim.AdamW(policy.parameters(), lr=5e-3)
    for _ in range(200):
        optimizer.zero_grad()
        policy.losses(batch)["loss"].backward()
        optimizer.step()
    one = Observation(images[:1], torch.zeros(1, 2))
    drawn = torch.cat([policy.sample(one, seed).actions for seed in range(16)])  # (16, 2, 2)
    assert (drawn.abs() - 0.5).abs().mean() < 0.1
    ways = drawn.mean((1, 2))  # (16,)
    assert (ways.abs() > 0.3).all()
    assert 3 <= (ways > 0).sum() <= 13

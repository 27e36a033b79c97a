"""Refinement towards where the hands will grip next."""

import numpy as np
import pytest
import torch
from deployed import tiny_act

from ugr_lightning.contract import Batch, Keyframes
from ugr_lightning.errors import ConfigError
from ugr_lightning.models.keyframes import KeyframeSettings
from ugr_lightning.models.reach import Reach, require_arms, tools_of
from ugr_lightning.models.refine.full import Full
from ugr_lightning.sim.kinematics import HOME, SIDES, forward, to_world

STEPS, DIM = 8, 16


@pytest.fixture
def postures():
    """Arms above a table, (3, 2, 6) rad."""
    return HOME + np.random.default_rng(0).uniform(-0.6, 0.6, (3, 2, 6))


def tools_in_world(postures):
    """(n, 2, 3) m."""
    found = [[to_world(side, forward(q)).position for side, q in zip(SIDES, both, strict=True)] for both in postures]
    return torch.tensor(np.array(found), dtype=torch.float32)


def commands(postures):
    """Chunks (n, K, 14) that hold postures, grippers half open."""
    whole = np.concatenate([postures, np.full((len(postures), 2, 1), 0.5)], -1).reshape(-1, 1, 14)
    return torch.tensor(whole, dtype=torch.float32).expand(-1, STEPS, -1)


def taught(share):
    """A branch whose every step wants the same share of the motion."""
    built = Reach(DIM)
    built.share[-1].bias.data.fill_(share)
    return built


def test_tools_and_their_motions_are_those_of_the_closed_form(postures):
    joints = torch.tensor(postures)
    tools, moves = tools_of(joints)
    for arm in np.ndindex(3, 2):
        assert tools[arm].numpy() == pytest.approx(forward(postures[arm]).position, abs=1e-9)
        for joint in range(6):
            turned = postures[arm] + 1e-6 * np.eye(6)[joint]
            difference = (forward(turned).position - forward(postures[arm]).position) / 1e-6
            assert moves[arm][:, joint].numpy() == pytest.approx(difference, abs=1e-5)


def test_a_branch_that_has_learned_nothing_changes_nothing(postures):
    added = Reach(DIM)(torch.randn(3, STEPS, DIM), commands(postures), torch.zeros(3, 2, 3))
    assert added.shape == (3, STEPS, 14)
    assert not added.any()


def test_a_batch_without_a_step_that_counts_teaches_nothing(postures):
    shown, none = commands(postures), torch.zeros(3, STEPS, dtype=torch.bool)
    assert taught(0.5).lesson(torch.zeros(3, STEPS, DIM), shown, torch.zeros(3, 2, 3), shown, none) == 0


def test_a_whole_share_brings_the_tools_to_the_points_and_leaves_the_grippers(postures):
    points = tools_in_world(postures) + torch.tensor([0.01, -0.008, 0.006])
    coarse = commands(postures)
    added = taught(1.0)(torch.zeros(3, STEPS, DIM), coarse, points)
    assert not added[..., [6, 13]].any()
    reached = tools_in_world((coarse + added)[:, 0].unflatten(-1, (2, 7))[..., :6].detach().numpy())
    assert (points - tools_in_world(postures)).norm(dim=-1).min() > 0.014
    assert (points - reached).norm(dim=-1).max() < 0.003  # damping leaves a rest


def test_the_motion_is_the_same_in_mirror_image(postures):
    points = tools_in_world(postures) + 0.01
    added = taught(1.0)(torch.zeros(3, STEPS, DIM), commands(postures), points)
    other = postures[:, ::-1] * [-1, 1, 1, -1, 1, -1]
    swapped = points.flip(1) * torch.tensor([-1, 1, 1])
    mirrored = taught(1.0)(torch.zeros(3, STEPS, DIM), commands(other), swapped)
    sign = torch.tensor([-1, 1, 1, -1, 1, -1, 1])
    assert torch.allclose(mirrored.unflatten(-1, (2, 7)), added.unflatten(-1, (2, 7)).flip(2) * sign, atol=1e-5)


@pytest.mark.parametrize(("wrong", "beside", "first"), [(0.02, 0.0, 0.0), (0.0, 0.05, 0.5)], ids=["chunk", "points"])
def test_a_share_is_learned_where_the_points_are_right_and_none_where_the_chunk_is(postures, wrong, beside, first):
    torch.manual_seed(0)
    branch, hidden = taught(first), torch.zeros(3, STEPS, DIM, requires_grad=True)
    shown, coarse = commands(postures), commands(postures + wrong)
    points, valid = tools_in_world(postures) + beside, torch.ones(3, STEPS, dtype=torch.bool)
    optimizer = torch.optim.Adam(branch.parameters(), 1e-2)
    before = branch.lesson(hidden, coarse, points, shown, valid).item()
    for _ in range(60):
        optimizer.zero_grad()
        branch.lesson(hidden, coarse, points, shown, valid).backward()
        optimizer.step()
    assert branch.lesson(hidden, coarse, points, shown, valid).item() < 0.3 * before
    assert hidden.grad is None  # the rest of a policy does not learn from it


def labelled(postures, position):
    """One chunk a posture, whose keyframes are at its third command."""
    count = len(postures)
    keyframes = Keyframes(position, torch.zeros(count, 2, 6), torch.full((count, 2), 3))
    valid, number = torch.ones(count, STEPS, dtype=torch.bool), torch.arange(count)
    return Batch(
        torch.zeros(count, 1), torch.zeros(count, 14), commands(postures), valid, number, number, None, keyframes
    )


def test_arms_that_are_others_are_refused(postures):
    position = tools_in_world(postures)
    require_arms(labelled(postures, position + 0.01))
    with pytest.raises(ConfigError, match="another robot"):
        require_arms(labelled(postures, position + 0.2))


def test_keyframes_beyond_their_chunks_say_nothing_of_the_arms(postures):
    batch = labelled(postures, tools_in_world(postures) + 0.2)
    later = batch.keyframes._replace(delay=torch.full((3, 2), STEPS + 1))
    require_arms(batch._replace(keyframes=later))


def test_a_policy_without_keyframes_cannot_reach_for_them():
    with pytest.raises(ConfigError, match="looks for keyframes"):
        tiny_act(refine=Full(), refine_branch="reach")
    assert tiny_act(refine=Full(), refine_branch="reach", keyframes=KeyframeSettings(channels=8)).reach is not None

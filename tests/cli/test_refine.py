"""`ugr refine` from a trained checkpoint to one that is refined."""

import re

import numpy as np
import pytest
import torch
from deployed import looking_act, tiny_act
from recordings import record
from tiny import TinyPolicy

from ugr_lightning.cli.main import main
from ugr_lightning.embodiment import CAMERAS
from ugr_lightning.models.checkpoint import load_policy
from ugr_lightning.models.refine.full import Full
from ugr_lightning.models.refine.uncertainty import Uncertainty
from ugr_lightning.sim.kinematics import HOME, SIDES, forward, to_world
from ugr_lightning.uncertainty import refitting
from ugr_lightning.uncertainty.predictions import batches

STEPS = 12


@pytest.fixture
def demonstrations(tmp_path):
    """Root of ten demonstrations whose tools are where the commands take them."""
    joints = HOME + np.random.default_rng(0).uniform(-0.4, 0.4, (STEPS, 2, 6))
    commands = np.concatenate([joints, np.full((STEPS, 2, 1), 0.5)], -1).reshape(STEPS, 14)
    places = [[to_world(side, forward(q)).position for side, q in zip(SIDES, both, strict=True)] for both in joints]
    tools = np.concatenate([places, np.tile([1.0, 0, 0, 0], (STEPS, 2, 1))], -1)  # (T, 2, 7)
    shown = {"expert_action": commands.astype(np.float32), "endpose": np.concatenate([tools[:1], tools])}
    record(tmp_path / "known", 10, STEPS, 0, size=(32, 48), **shown)
    return tmp_path / "known"


def command(tmp_path, root, *given):
    return ["refine", str(tmp_path / "policy_best.ckpt"), "--data", str(root), "--stride", "3", *given]


def test_a_policy_learns_to_refine_and_keeps_everything_else(demonstrations, untrained, tmp_path, capsys):
    policy = looking_act(refine=Uncertainty())
    torch.nn.init.normal_(policy.branch.head.weight)  # it had learned to refine in another way
    untrained(policy, tmp_path, {"root": str(demonstrations)})
    assert main(command(tmp_path, demonstrations)) == 0
    said = capsys.readouterr().out
    before, after = map(float, re.search(r"action error .*: (\S+) and (\S+)", said).groups())
    assert after < before
    assert "tools at keyframes, before and after" in said
    trained, _ = load_policy(tmp_path / "policy_best.ckpt")
    refined, info = load_policy(tmp_path / "policy_best_refined.ckpt")
    assert info.data["task"] == "click_alarmclock"
    assert info.step == 7
    kept = trained.state_dict()
    for name, value in refined.state_dict().items():
        if not name.startswith("branch."):
            assert torch.equal(value, kept[name]), name
    assert refined.branch.head.weight.any()
    assert isinstance(refined.refine, Full)


def test_a_former_refinement_is_forgotten():
    policy = looking_act(refine=Uncertainty())
    torch.nn.init.normal_(policy.branch.head.weight)
    assert not refitting.with_refinement(policy, Full()).branch.head.weight.any()


def test_which_steps_are_refined_is_a_choice(demonstrations, untrained, tmp_path, capsys):
    untrained(looking_act(uncertainty_head=True), tmp_path, {"root": str(demonstrations)})
    given = ("--refine", "ugr_lightning.models.refine.uncertainty.Uncertainty", "--refine.ratio", "0.5")
    assert main(command(tmp_path, demonstrations, *given)) == 0
    refined, _ = load_policy(tmp_path / "policy_best_refined.ckpt")
    assert isinstance(refined.refine, Uncertainty)
    assert refined.refine.ratio == 0.5
    untrained(looking_act(), tmp_path, {"root": str(demonstrations)})
    assert main(command(tmp_path, demonstrations, *given)) == 2
    assert "a policy with an uncertainty head" in " ".join(capsys.readouterr().err.split())


def test_the_same_checkpoint_learns_the_same(demonstrations, untrained, tmp_path):
    untrained(looking_act(), tmp_path, {"root": str(demonstrations)})
    for out in ("one.ckpt", "two.ckpt"):
        assert main(command(tmp_path, demonstrations, "--out", str(tmp_path / out))) == 0
    one, two = (load_policy(tmp_path / name)[0].state_dict() for name in ("one.ckpt", "two.ckpt"))
    assert all(torch.equal(value, two[name]) for name, value in one.items())


def test_a_policy_without_keyframes_or_uncertainty_is_refined_too(ten_demonstrations, untrained, tmp_path, capsys):
    untrained(tiny_act(), tmp_path)
    assert main(command(tmp_path, ten_demonstrations)) == 0
    assert "action error" in capsys.readouterr().out


def test_other_policies_are_refused(ten_demonstrations, untrained, tmp_path, capsys):
    untrained(TinyPolicy(cameras=CAMERAS, dim=14), tmp_path)
    assert main(command(tmp_path, ten_demonstrations)) == 2
    assert "class ACT" in capsys.readouterr().err
    assert not (tmp_path / "policy_best_refined.ckpt").exists()


def test_before_is_what_the_checkpoint_does_also_if_it_refines(ten_demonstrations, untrained, tmp_path, capsys):
    policy = tiny_act(refine=Uncertainty())
    torch.nn.init.normal_(policy.branch.head.weight)
    untrained(policy, tmp_path)
    said = []
    for name in ("policy_best.ckpt", "policy_best_refined.ckpt"):
        assert main(["refine", str(tmp_path / name), *command(tmp_path, ten_demonstrations)[2:]]) == 0
        said.append(re.search(r"action error .*: (\S+) and (\S+)", capsys.readouterr().out).groups())
    assert said[1][0] == said[0][1]


def test_a_file_that_is_there_is_not_overwritten(ten_demonstrations, untrained, tmp_path, capsys):
    file = untrained(tiny_act(), tmp_path)
    before = file.read_bytes()
    for out in (file, tmp_path):
        assert main(command(tmp_path, ten_demonstrations, "--out", str(out))) == 2
        assert "a file that does not exist yet" in capsys.readouterr().err
    assert file.read_bytes() == before


def test_a_rule_is_told_no_uncertainty_where_the_policy_has_none(ten_demonstrations, untrained, tmp_path, monkeypatch):
    told, select = [], Full.select
    monkeypatch.setattr(Full, "select", lambda self, *given: told.append(given[0]) or select(self, *given))
    untrained(tiny_act(), tmp_path)
    assert main(command(tmp_path, ten_demonstrations)) == 0
    assert told
    assert all(one is None for one in told)


def test_episodes_that_teach_the_uncertainty_alone_teach_no_refinement(
    ten_demonstrations, untrained, tmp_path, monkeypatch
):
    asked = []
    monkeypatch.setattr(
        refitting, "batches", lambda data, episodes, **how: asked.append(episodes) or batches(data, episodes, **how)
    )
    untrained(tiny_act(refine=Uncertainty(), uncertainty_holdout=2), tmp_path)
    assert main(command(tmp_path, ten_demonstrations)) == 0
    assert asked[0]
    assert all(episode % 2 for episode in asked[0])

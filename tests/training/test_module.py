import csv
import math
import warnings

import pytest
import torch
from deployed import looking_act
from lightning.pytorch import Trainer
from tiny import TinyData, TinyPolicy, TinySamples, collate, train

from ugr_lightning.errors import ConfigError, NumericsError
from ugr_lightning.training.module import PolicyModule, check_fit, found_by

QUIET = {"enable_progress_bar": False, "enable_model_summary": False, "enable_checkpointing": False}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """One short training, and its folder."""
    folder = tmp_path_factory.mktemp("runs") / "tiny" / "version_0"
    return train(folder, max_epochs=2), folder


def test_every_loss_term_and_score_is_logged(run):
    _, folder = run
    logged = set(next(csv.reader((folder / "metrics.csv").open())))
    expected = {
        "train/loss",
        "train/coarse",
        "train/uncertainty",
        "train/learning_rate",
        "val/loss",
        "val/action_error",
    }
    expected |= {
        "val/first_frame_error",
        "val/coarse_error",
        "val/refined_error",
        "val/spearman",
        "val/selector_recall",
    }
    expected |= {"val/coarse_error_inside_mask", "val/error_inside_mask", "val/error_outside_mask"}
    assert expected <= logged


def test_validation_scores_are_means_over_valid_steps_in_standard_deviations(run):
    trainer, _ = run
    module, data = trainer.lightning_module.eval(), TinySamples(range(3, 4))
    batch = collate([data[i] for i in range(len(data))])
    chunk = module.policy.predict(batch.observation)
    error = ((chunk.actions - batch.actions).abs() / TinyData().statistics.action_std).mean(-1)
    scores = {name: float(value) for name, value in trainer.callback_metrics.items()}
    assert scores["val/action_error"] == pytest.approx(float(error[batch.valid].mean()), rel=1e-5)
    assert scores["val/first_frame_error"] == pytest.approx(float(error[0][batch.valid[0]].mean()), rel=1e-5)
    inside = batch.valid & chunk.refined
    assert scores["val/error_inside_mask"] == pytest.approx(float(error[inside].mean()), rel=1e-5)
    outside = batch.valid & ~chunk.refined
    assert scores["val/error_outside_mask"] == pytest.approx(float(error[outside].mean()), rel=1e-5)
    coarse = (chunk.coarse - batch.actions).abs().mean(-1)
    assert scores["val/coarse_error"] == pytest.approx(float(coarse[batch.valid].mean()), rel=1e-5)


def test_statistics_of_the_data_reach_the_policy(run):
    trainer, _ = run
    assert torch.equal(trainer.lightning_module.policy.mean, TinyData().statistics.action_mean)


def test_a_nan_loss_stops_training_and_leaves_what_is_needed_to_replay_it(tmp_path):
    folder = tmp_path / "runs" / "tiny" / "version_0"
    with pytest.raises(NumericsError) as caught:
        train(folder, TinyPolicy(poison_at=8), max_epochs=3)
    assert "training step 7" in str(caught.value)
    assert "coarse = nan" in str(caught.value)
    dump = torch.load(folder / "not_finite_step7.pt", weights_only=True)
    assert dump["batch"]["state"].shape[1] == 3
    assert str(int(dump["batch"]["episode"][0])) + ":" in str(caught.value)
    assert (folder / "last.ckpt").is_file(), "the checkpoint of the first epoch is still there"


@pytest.mark.parametrize("precision", ["bf16-mixed", "16-mixed"])
def test_mixed_precision_of_the_trainer_trains_float32_weights_with_clipping(tmp_path, precision):
    policy = TinyPolicy()
    before = policy.head.weight.detach().clone()
    with warnings.catch_warnings(action="ignore"):  # 16-mixed is bf16-mixed on a CPU, says Lightning
        train(tmp_path / "tiny" / "version_0", policy, max_epochs=1, precision=precision, gradient_clip_val=1.0)
    assert policy.head.weight.dtype == torch.float32
    assert policy.head.weight.isfinite().all()
    assert not torch.equal(policy.head.weight, before)


def test_a_trainer_that_would_change_the_type_of_the_weights_is_told_of_the_policys_precision(tmp_path):
    with pytest.raises(ConfigError, match="precision: bf16"):
        train(tmp_path / "tiny" / "version_0", max_epochs=1, precision="bf16-true")


def test_the_optimiser_takes_its_settings(tmp_path):
    given = {"learning_rate": 2e-4, "weight_decay": 1e-6, "betas": (0.95, 0.99)}
    module = PolicyModule(TinyPolicy(), **given)
    trainer = Trainer(accelerator="cpu", max_steps=1, default_root_dir=tmp_path, logger=False, **QUIET)
    trainer.fit(module, datamodule=TinyData())
    (group,) = trainer.optimizers[0].param_groups
    assert (group["lr"], group["weight_decay"], group["betas"]) == (2e-4, 1e-6, (0.95, 0.99))


def test_diffusion_policys_schedule_begins_and_ends_at_zero():
    module = PolicyModule(TinyPolicy(), warmup_steps=10, schedule="cosine_to_zero")
    factors = [module.learning_rate_factor(step, 110) for step in (0, 5, 10, 60, 110)]
    assert factors == pytest.approx([0, 0.5, 1, 0.5, 0], abs=1e-12)


def test_schedule_warms_up_and_ends_at_a_hundredth():
    module = PolicyModule(TinyPolicy(), warmup_steps=10, schedule="cosine")
    factors = [module.learning_rate_factor(step, 110) for step in (0, 9, 10, 60, 110)]
    assert factors == pytest.approx([0.1, 1.0, 1.0, 0.505, 0.01])
    assert PolicyModule(TinyPolicy()).learning_rate_factor(10**6, 0) == 1.0


def test_recall_is_the_share_of_the_worst_valid_steps_that_were_chosen():
    error = torch.tensor([[5.0, 4, 3, 2, 1], [1, 2, 9, 9, 9], [1, 2, 3, 4, 5]])
    valid = torch.tensor([[True] * 5, [True, True, False, False, False], [True] * 5])
    refined = torch.tensor([[True, False, True, False, False], [False, True, True, False, False], [False] * 5])
    found, chosen = found_by(refined, error, valid)
    assert found.tolist() == [0.5, 1, 0]
    assert chosen.tolist() == [2, 1, 0]


def test_a_module_is_made_without_warnings():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        PolicyModule(TinyPolicy())


def test_the_backbone_and_the_keyframes_maps_learn_at_a_rate_of_their_own():
    module = PolicyModule(looking_act(), learning_rate=3e-4, backbone_learning_rate=1e-3)
    module.trainer = Trainer(**QUIET, logger=False, max_steps=1)
    names = {id(parameter): name for name, parameter in module.policy.named_parameters()}
    groups = module.configure_optimizers()["optimizer"].param_groups
    parts = {group["lr"]: {names[id(one)].partition(".")[0] for one in group["params"]} for group in groups}
    assert parts[1e-3] == {"backbone", "finder"}
    assert {"encoder", "decoder", "action_head", "input_proj"} <= parts[3e-4]


@pytest.mark.parametrize(
    "given",
    [
        {"learning_rate": -1.0},
        {"learning_rate": math.nan},
        {"learning_rate": math.inf},
        {"backbone_learning_rate": -1e-3},
        {"muon_learning_rate": -1e-3},
        {"weight_decay": -1.0},
        {"warmup_steps": -3},
        {"betas": (0.9, 1.0)},
        {"betas": (-0.1, 0.9)},
    ],
)
def test_numbers_that_no_training_can_have_are_named(given):
    with pytest.raises(ConfigError, match=rf"model\.{next(iter(given))}: expected"):
        PolicyModule(looking_act(), **given)


def test_a_policy_of_which_nothing_is_trained_is_refused_in_words():
    module = PolicyModule(TinyPolicy().requires_grad_(False))
    module.trainer = Trainer(**QUIET, logger=False, max_steps=1)
    with pytest.raises(ConfigError, match="none that are not frozen"):
        module.configure_optimizers()


def test_a_policy_without_transformer_layers_has_nothing_for_muon_and_is_refused_in_words():
    with pytest.raises(ConfigError, match=r"muon_learning_rate: expected a policy with transformer layers.*TinyPolicy"):
        PolicyModule(TinyPolicy(), muon_learning_rate=1e-3).parts()


@pytest.mark.parametrize(
    ("wanted", "message"),
    [
        ({"dim": 4}, r"made for \(state 4, action 4, cameras cam_high\), got state 3, action 3, cameras cam_high"),
        ({"cameras": ("cam_high", "top")}, r"cameras cam_high, top\), got .*cameras cam_high\."),
    ],
)
def test_a_policy_made_for_another_robot_is_refused_with_both_sides_shown(wanted, message):
    statistics = TinyData().statistics
    check_fit(TinyPolicy(), statistics, ["cam_high"])
    with pytest.raises(ConfigError, match=message):
        check_fit(TinyPolicy(**wanted), statistics, ["cam_high"])

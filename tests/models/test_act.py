"""The whole network: size, variants, gradients, promises of the contract."""

import pytest
import torch
from deployed import tiny_act

from ugr_lightning.blueprint import rebuild
from ugr_lightning.contract import Observation
from ugr_lightning.errors import CheckpointError, ConfigError, NumericsError
from ugr_lightning.models.act import ACT
from ugr_lightning.models.losses import refine_loss
from ugr_lightning.models.refine.block import Block
from ugr_lightning.models.refine.full import Full
from ugr_lightning.models.refine.uncertainty import Uncertainty
from ugr_lightning.models.vision import FrozenBatchNorm2d

VARIANTS = {
    "base": {},
    "cmask": {"causal": True},
    "full": {"refine": Full()},
    "block": {"refine": Block(3)},
    "uncert": {"refine": Uncertainty()},
}
COMPACT = {
    "backbone_stem": "unshuffle",
    "camera_embedding": True,
    "position_in_values": True,
    "keypoints": 4,
    "state_dropout": 0.5,
    "image_shift": 2,
    "color_jitter": 0.1,
}
every_variant = pytest.mark.parametrize("variant", VARIANTS)


def parameters(policy: torch.nn.Module) -> int:
    return sum(p.numel() for p in policy.parameters())


def noisy_branch(policy: ACT) -> ACT:
    """Move the zero-initialised last layer, so that refinement does something."""
    assert policy.branch is not None
    torch.nn.init.normal_(policy.branch.head.weight)
    return policy


def test_paper_size_has_the_parameters_of_the_public_code_that_are_used():
    decoder_layer = 5_384_832
    with torch.device("meta"):
        first = ACT(decoder_readout="first")
        last = ACT()
        uncert = ACT(refine=Uncertainty())
    assert parameters(first) == 83_897_487 - 6 * decoder_layer - 513 == 51_587_982  # less dead layers and is_pad head
    assert parameters(last) == parameters(first) + 6 * decoder_layer
    head, action_proj, mlp, residual = 513, 14 * 512 + 512, 512 * 512 + 512, 512 * 14 + 14
    assert parameters(uncert) == parameters(last) + head + action_proj + mlp + residual


@every_variant
@pytest.mark.parametrize("additions", [{}, COMPACT], ids=["plain", "compact"])
def test_every_variant_trains_and_every_parameter_gets_a_gradient(tiny, batch, variant, additions):
    policy = tiny(**VARIANTS[variant], **additions, dropout=0.1)
    terms = policy.losses(batch)
    expected = {"loss", "coarse", "kl"}
    expected |= {"refine"} if "refine" in VARIANTS[variant] else set()
    expected |= {"uncertainty"} if variant == "uncert" else set()
    assert set(terms) == expected
    terms["loss"].backward()
    assert [name for name, p in policy.named_parameters() if p.grad is None] == []
    assert all(term.dtype == torch.float32 and term.isfinite() for term in terms.values())


@every_variant
def test_prediction_has_the_shapes_of_the_contract(tiny, batch, variant):
    chunk = tiny(**VARIANTS[variant]).predict(batch.observation)
    assert chunk.actions.shape == (3, 10, 14)
    assert chunk.actions.dtype == torch.float32
    assert (chunk.log_variance is not None) == (variant == "uncert")
    assert (chunk.refined is not None) == (chunk.coarse is not None) == ("refine" in VARIANTS[variant])
    if chunk.refined is not None:
        assert chunk.refined.sum(1).tolist() == [{"full": 10, "block": 3, "uncert": 3}[variant]] * 3


@pytest.mark.parametrize("variant", ["full", "block", "uncert"])
def test_training_starts_at_the_coarse_policy(tiny, batch, variant):
    chunk = tiny(**VARIANTS[variant]).predict(batch.observation)
    assert torch.equal(chunk.actions, chunk.coarse)
    assert torch.equal(chunk.actions, tiny().predict(batch.observation).actions)


@pytest.mark.parametrize("variant", ["block", "uncert"])
def test_only_chosen_steps_are_changed(tiny, batch, variant):
    chunk = noisy_branch(tiny(**VARIANTS[variant])).predict(batch.observation)
    changed = (chunk.actions != chunk.coarse).any(-1)
    assert torch.equal(changed, chunk.refined)


def test_a_selector_that_breaks_a_promise_is_refused_before_any_training(tiny, monkeypatch):
    monkeypatch.setattr(Full, "select", lambda self, log_variance, valid, training: valid.float())
    with pytest.raises(ConfigError, match=r"Full\.select: expected bool \(2, 10\)"):
        tiny(refine=Full())


def test_sparse_prediction_equals_dense_prediction(tiny, batch):
    policy = noisy_branch(tiny(refine=Uncertainty()))
    sparse = policy.predict(batch.observation)
    policy.budget = None  # takes the dense path
    dense = policy.predict(batch.observation)
    assert (dense.actions != dense.coarse).any()
    assert torch.allclose(sparse.actions, dense.actions, atol=1e-5)


def causal_influence(policy: ACT, readout_batch) -> torch.Tensor:
    """How much step j of the coarse chunk reacts to the query of step k, (K, K), strictly later k kept."""
    policy.eval()
    before = policy.predict(readout_batch.observation).actions
    reaction = torch.zeros(10, 10)
    for k in range(10):
        with torch.no_grad():
            policy.query_embed[k] += 1
            reaction[:, k] = (policy.predict(readout_batch.observation).actions - before).abs().amax((0, 2))
            policy.query_embed[k] -= 1
    return reaction


def test_cmask_keeps_later_steps_from_earlier_ones_and_base_does_not(tiny, batch):
    causal, base = (causal_influence(tiny(causal=flag), batch) for flag in (True, False))
    assert causal.triu(1).max() < 1e-5
    assert causal.tril(-1).max() > 1e-4
    assert base.triu(1).max() > 1e-4


def test_cmask_changes_the_output_with_the_last_layer_and_nothing_with_the_first(tiny, batch):
    for readout, differs in (("last", True), ("first", False)):
        outputs = [
            tiny(decoder_readout=readout, causal=flag).predict(batch.observation).actions for flag in (True, False)
        ]
        assert bool((outputs[0] - outputs[1]).abs().max() > 1e-4) is differs


def test_uncertainty_loss_moves_nothing_but_its_head(tiny, batch):
    policy = tiny(refine=Uncertainty())
    policy.losses(batch)["uncertainty"].backward()
    moved = {name for name, p in policy.named_parameters() if p.grad is not None and p.grad.any()}
    assert moved == {"uncertainty_head.weight", "uncertainty_head.bias"}


@pytest.mark.parametrize("detach", [False, True])
def test_refine_detach_coarse_cuts_the_gradient_into_the_action_head(tiny, batch, detach):
    policy = noisy_branch(tiny(refine=Full(), refine_detach_coarse=detach))
    policy.losses(batch)["refine"].backward()
    grad = policy.action_head.weight.grad
    assert (grad is not None and bool(grad.any())) is not detach
    assert policy.branch.head.weight.grad.any()


def test_total_is_the_weighted_sum_of_the_terms(tiny, batch):
    terms = tiny(refine=Uncertainty(), kl_weight=3.0, uncertainty_weight=0.5, coarse_weight=2.0).losses(batch)
    expected = 2 * terms["coarse"] + terms["refine"] + 0.5 * terms["uncertainty"] + 3 * terms["kl"]
    assert terms["loss"].item() == pytest.approx(expected.item(), rel=1e-5)


def test_losses_are_those_of_the_prediction(tiny, batch):
    policy = noisy_branch(tiny(refine=Block(3), cvae_layers=0, backbone_norm="group")).eval()
    terms, chunk = policy.losses(batch), policy.predict(batch.observation)
    target = policy.normalizer.action(batch.actions)
    expected = refine_loss(policy.normalizer.action(chunk.actions), target, chunk.refined, batch.valid)
    assert terms["refine"].item() == pytest.approx(expected.item(), rel=1e-4)


def test_actions_on_padded_steps_change_no_term(tiny, batch):
    policy = tiny(refine=Uncertainty()).eval()
    other = batch.actions.clone()
    other[~batch.valid] = 1e3
    before, after = policy.losses(batch), policy.losses(batch._replace(actions=other))
    assert {k: v.item() for k, v in after.items()} == pytest.approx({k: v.item() for k, v in before.items()}, rel=1e-5)


def test_uncertainty_head_can_be_had_without_refinement_and_changes_no_other_gradient(tiny, batch):
    plain, headed = tiny(), tiny(uncertainty_head=True)
    headed.load_state_dict(plain.state_dict(), strict=False)
    for policy in (plain, headed):
        torch.manual_seed(5)
        policy.losses(batch)["loss"].backward()
    assert torch.equal(plain.action_head.weight.grad, headed.action_head.weight.grad)
    assert headed.predict(batch.observation).log_variance.shape == (3, 10)


def test_log_variance_is_bounded_and_float32_in_bf16(tiny, batch):
    policy = tiny(uncertainty_head=True, precision="bf16")
    torch.nn.init.normal_(policy.uncertainty_head.weight, std=1e4)
    log_variance = policy.predict(batch.observation).log_variance
    assert log_variance.dtype == torch.float32
    assert log_variance.abs().max() == 10


def test_bf16_stays_close_to_fp32(tiny, batch):
    exact, fast = (tiny(precision=p, refine=Full()).eval() for p in ("fp32", "bf16"))
    difference = exact.losses(batch)["coarse"] - fast.losses(batch)["coarse"]
    assert 0 < difference.abs() < 0.05 * exact.losses(batch)["coarse"]


@every_variant
def test_mixed_precision_around_the_policy_reaches_the_trunk_and_spares_heads_and_losses(tiny, batch, variant):
    policy = tiny(**VARIANTS[variant], precision="auto")
    reached = []
    policy.decoder_norm.register_forward_hook(lambda _, __, output: reached.append(output.dtype))
    with torch.autocast("cpu", torch.bfloat16):
        terms = policy.losses(batch)
        chunk = policy.predict(batch.observation)
    terms["loss"].backward()
    assert reached == [torch.bfloat16] * 2
    assert {term.dtype for term in terms.values()} == {chunk.actions.dtype} == {torch.float32}


def test_evaluation_losses_have_no_randomness_and_training_losses_do(tiny, batch):
    policy = tiny(dropout=0.1, refine=Block(3), **COMPACT)
    assert policy.losses(batch)["loss"] != policy.losses(batch)["loss"]
    policy.eval()
    state = torch.get_rng_state()
    assert policy.losses(batch)["loss"] == policy.losses(batch)["loss"]
    assert torch.equal(state, torch.get_rng_state())


def test_prediction_is_the_same_in_either_mode_and_leaves_the_mode_alone(tiny, batch):
    policy = tiny(dropout=0.5, refine=Block(3), **COMPACT)
    policy.losses(batch)  # moves BatchNorm's running statistics off their start
    training = policy.predict(batch.observation).actions
    assert policy.training
    assert torch.equal(training, policy.eval().predict(batch.observation).actions)
    assert not policy.training


def test_prediction_does_not_depend_on_its_neighbours_in_the_batch(tiny, batch):
    policy = noisy_branch(tiny(refine=Uncertainty(), **COMPACT))
    policy.losses(batch)
    together = policy.predict(batch.observation).actions
    alone = policy.predict(Observation(batch.images[1:2], batch.state[1:2])).actions
    assert torch.allclose(together[1:2], alone, atol=1e-5)


@pytest.mark.parametrize("norm", ["batch", "frozen", "group"])
@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_inference_copy_predicts_the_same(tiny, batch, norm, precision):
    policy = noisy_branch(tiny(backbone_norm=norm, refine=Full(), precision=precision, **COMPACT))
    for name, buffer in policy.backbone.named_buffers():
        if "running" in name or (norm == "frozen" and name.endswith(("weight", "bias"))):
            buffer.uniform_(0.5, 1.5)
    policy.backbone.pretrained.fill_(True)
    fast = policy.for_inference()
    expected, got = policy.predict(batch.observation), fast.predict(batch.observation)
    difference = (got.actions - expected.actions).abs().mean() / expected.actions.std()
    assert difference < (1e-5 if precision == "fp32" else 0.03)
    assert policy.training
    assert not any(parameter.requires_grad for parameter in fast.parameters())
    assert not any(isinstance(m, torch.nn.BatchNorm2d | FrozenBatchNorm2d) for m in fast.backbone.modules())


def test_inference_copy_keeps_what_must_be_exact_with_all_that_is_in_it():
    class Exact(ACT):
        exact = ("action_head", "encoder.1")

    fast = tiny_act(encoder_layers=2, precision="bf16")
    fast.__class__ = Exact
    fast = fast.for_inference()
    assert {parameter.dtype for parameter in fast.encoder[1].parameters()} == {torch.float32}
    assert fast.action_head.weight.dtype == torch.float32
    assert fast.encoder[0].linear1.weight.dtype == torch.bfloat16


def test_inference_copy_has_a_life_of_its_own(tiny, batch):
    policy = tiny()
    fast = policy.for_inference()
    before = fast.predict(batch.observation).actions
    with torch.no_grad():
        policy.action_head.bias += 1
    assert torch.equal(fast.predict(batch.observation).actions, before)


def test_prediction_ignores_the_posterior(tiny, batch):
    policy = tiny()
    before = policy.predict(batch.observation).actions
    for parameter in policy.posterior.parameters():
        torch.nn.init.normal_(parameter)
    assert torch.equal(before, policy.predict(batch.observation).actions)


def test_policy_without_cvae_has_no_kl(tiny, batch):
    assert set(tiny(cvae_layers=0).losses(batch)) == {"loss", "coarse"}


@every_variant
def test_blueprint_and_state_dict_rebuild_an_equal_policy(tiny, batch, variant):
    policy = tiny(**VARIANTS[variant], **COMPACT)
    policy.losses(batch)
    again = rebuild(policy.blueprint())
    again.load_state_dict(policy.state_dict())
    for ours, theirs in zip(policy.predict(batch.observation), again.predict(batch.observation), strict=True):
        assert (ours is None) == (theirs is None)
        assert ours is None or torch.equal(ours, theirs)


def test_blueprint_forgets_where_the_backbone_came_from(tiny, tmp_path):
    weights = tiny().backbone.state_dict()
    torch.save({f"backbone.{key}": value for key, value in weights.items()}, tmp_path / "weights.pth")
    policy = tiny(backbone_norm="frozen", backbone_weights=str(tmp_path / "weights.pth"))
    (tmp_path / "weights.pth").unlink()
    again = rebuild(policy.blueprint())
    again.load_state_dict(policy.state_dict())
    assert again.backbone.pretrained


def test_any_image_size_works_with_one_policy(tiny, batch):
    policy = tiny()
    policy.predict(batch.observation)
    larger = torch.zeros(1, 3, 3, 64, 96, dtype=torch.uint8)
    assert policy.predict(Observation(larger, batch.state[:1])).actions.shape == (1, 10, 14)


def test_statistics_enter_and_leave(tiny, batch, statistics):
    policy = tiny()
    shift = torch.arange(14.0)
    moved = statistics._replace(action_mean=statistics.action_mean + shift)
    before = policy.predict(batch.observation).actions
    policy.set_statistics(moved)
    assert torch.allclose(policy.predict(batch.observation).actions, before + shift, atol=1e-5)


def test_cameras_are_told_apart_only_with_an_embedding(tiny, batch):
    swapped = Observation(batch.images[:, [2, 1, 0]], batch.state)
    for embedding in (False, True):
        policy = tiny(camera_embedding=embedding)
        if embedding:
            torch.nn.init.normal_(policy.camera_embed)
        difference = policy.predict(swapped).actions - policy.predict(batch.observation).actions
        assert bool(difference.abs().max() > 1e-3) is embedding


def test_hidden_state_reaches_nothing(tiny, batch):
    policy = tiny(state_dropout=1.0)
    other = Observation(batch.images, batch.state + 1)
    assert torch.equal(policy.predict(other).actions, policy.predict(batch.observation).actions)


def test_state_dropout_hides_its_share_of_samples_in_training(tiny):
    policy = tiny(state_dropout=0.25)
    hidden = (policy.disturb(torch.ones(4000, 14))[0] == 0).all(1)
    assert hidden.float().mean().item() == pytest.approx(0.25, abs=0.03)
    assert torch.equal(policy.eval().disturb(torch.ones(2, 14))[0], torch.ones(2, 14))


def test_wrong_observations_are_refused(tiny, batch):
    images, state, broken = batch.images, batch.state, batch.state.clone()
    broken[1, 3] = torch.nan
    for wrong, error, message in (
        (Observation(images[:, :2], state), ConfigError, "cam_right_wrist"),
        (Observation(images.float(), state), ConfigError, "uint8"),
        (Observation(images, broken), NumericsError, r"observation\.state"),
    ):
        with pytest.raises(error, match=message):
            tiny().predict(wrong)


def test_nan_prediction_is_refused(tiny, batch):
    policy = tiny()
    with torch.no_grad():
        policy.action_head.bias[2] = torch.nan
    with pytest.raises(NumericsError, match="predicted actions"):
        policy.predict(batch.observation)


def test_policy_without_statistics_does_not_predict(tiny, batch):
    policy = rebuild(tiny().blueprint())
    with pytest.raises(CheckpointError, match="statistics"):
        policy.predict(batch.observation)


def test_heads_that_do_not_divide_the_width_are_refused(tiny):
    with pytest.raises(ConfigError, match="heads"):
        tiny(heads=3)


def test_held_out_episodes_teach_the_uncertainty_and_the_others_everything_else(tiny, batch):
    policy = noisy_branch(tiny(refine=Uncertainty(), uncertainty_holdout=2))

    def learned_from(held_out):
        policy.zero_grad()
        episode = torch.full_like(batch.episode, 4 if held_out else 5)
        terms = policy.losses(batch._replace(episode=episode))
        (terms["loss"] - policy.kl_weight * terms["kl"]).backward()
        return {name for name, p in policy.named_parameters() if p.grad is not None and p.grad.any()}

    head = {"uncertainty_head.weight", "uncertainty_head.bias"}
    assert learned_from(held_out=True) == head
    others = learned_from(held_out=False)
    assert others.isdisjoint(head)
    assert {"action_head.weight", "branch.head.weight", "query_embed", "state_proj.weight"} <= others


def test_holding_episodes_out_changes_neither_validation_nor_predictions(tiny, batch):
    plain, other = (tiny(refine=Uncertainty(), uncertainty_holdout=n).eval() for n in (0, 2))
    assert plain.losses(batch) == other.losses(batch)
    assert torch.equal(plain.predict(batch.observation).log_variance, other.predict(batch.observation).log_variance)


@pytest.mark.parametrize(("n", "refine"), [(1, Uncertainty()), (-5, Uncertainty()), (5, Full()), (5, None)])
def test_holding_out_all_episodes_or_those_of_no_uncertainty_is_refused(tiny, n, refine):
    with pytest.raises(ConfigError, match="uncertainty_holdout"):
        tiny(refine=refine, uncertainty_holdout=n)


def test_base_with_the_parameters_of_uncert_has_exactly_as_many_and_learns_through_the_branch(tiny, batch):
    control = tiny(refine=Full(), uncertainty_head=True, coarse_weight=0.0)
    assert parameters(control) == parameters(tiny(refine=Uncertainty()))
    control.losses(batch)["loss"].backward()
    assert control.action_head.weight.grad.abs().sum() > 0
    assert control.branch.head.weight.grad.abs().sum() > 0

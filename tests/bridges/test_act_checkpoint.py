import pytest
import torch
from published_act import SMALL, seen, small

from ugr_lightning.bridges.act_checkpoint import DEAD, ORIGINAL, export_act, import_act
from ugr_lightning.bridges.act_layout import sizes_of, translate
from ugr_lightning.bridges.act_statistics import ActStatistics
from ugr_lightning.contract import Observation
from ugr_lightning.errors import CheckpointError, ConfigError
from ugr_lightning.models.act import ACT
from ugr_lightning.speed.reference_act import ReferenceACT

TWO = ("top", "wrist")


@pytest.fixture
def original():
    """Seven decoder layers, of which the first is read."""
    return small(ReferenceACT, decoder_layers=7)


@pytest.fixture
def images():
    return seen()[0]


@pytest.fixture
def state():
    return seen()[1]


@pytest.fixture
def statistics():
    draw = torch.Generator().manual_seed(3)
    mean, std = torch.randn(9, generator=draw), torch.rand(9, generator=draw) + 0.01
    return ActStatistics(mean[:5], std[:5], mean[5:], std[5:], torch.randn(7, 5, generator=draw))


@pytest.fixture
def weights(original):
    return {f"model.{name}": value for name, value in original.state_dict().items()}


def executed(original, statistics, images, state, latent=None):
    """What the original code sends to the robot."""
    with torch.no_grad():
        actions = original(images / 255, (state - statistics.qpos_mean) / statistics.qpos_std, latent)
    return actions * statistics.action_std + statistics.action_mean


@pytest.mark.parametrize(("prefix", "latent"), [("model.", None), ("", torch.tensor([[1.0, -2, 0], [0, 1, 2]]))])
def test_an_imported_policy_commands_what_the_original_commands(original, statistics, images, state, prefix, latent):
    weights = {prefix + name: value for name, value in original.state_dict().items()}
    policy, _ = import_act(weights, statistics, cameras=TWO, heads=4)
    if latent is not None:
        policy.latent_out_proj.register_forward_pre_hook(lambda layer, given: (latent,))
    ours = policy.predict(Observation(images, state)).actions
    theirs = executed(original, statistics, images, state, latent)
    assert theirs.std(dim=(0, 1)).min() > 1e-3, "the comparison is of numbers that differ"
    torch.testing.assert_close(ours, theirs, atol=1e-5, rtol=0)


def test_the_posterior_is_imported_too(original, weights, statistics, state):
    policy, _ = import_act(weights, statistics, cameras=TWO, heads=4)
    actions, valid = torch.randn(2, 6, 4), torch.arange(6).expand(2, 6) < torch.tensor([[6], [3]])
    with torch.no_grad():
        ours, theirs = policy.posterior(state, actions, valid), original.encode(state, actions, valid)
    torch.testing.assert_close(ours, theirs, atol=1e-5, rtol=0)


def test_every_tensor_is_consumed_or_named_as_unused(weights, statistics):
    policy, extra = import_act(weights, statistics, cameras=TWO, heads=4)
    layers = {name.split(".")[3] for name in extra["unused"] if name.startswith("transformer.decoder.layers.")}
    assert layers == set("123456")
    rest = {name for name in extra["unused"] if not name.startswith("transformer.decoder.layers.")}
    assert rest == {"is_pad_head.weight", "is_pad_head.bias"}
    imported = {name for name in policy.state_dict() if not name.startswith("normalizer.")} - {"backbone.pretrained"}
    assert len(imported) + len(extra["unused"]) + 1 == len(weights), "the position table is the one"


def test_what_goes_in_comes_out_bit_for_bit(weights, statistics):
    policy, extra = import_act(weights, statistics, cameras=TWO, heads=4)
    back = export_act(policy, extra)
    assert set(back.weights) == set(weights)
    for name, value in weights.items():
        assert torch.equal(back.weights[name], value) or name == "model.pos_table", name
    torch.testing.assert_close(back.weights["model.pos_table"], weights["model.pos_table"], atol=1e-6, rtol=0)
    for ours, theirs in zip(back.statistics, statistics, strict=True):
        assert torch.equal(ours, theirs)
    assert back.notes == []


def test_the_network_of_the_paper_is_imported_whole():
    """At the paper's size, where only names and shapes are compared: nothing of that size is computed."""
    with torch.device("meta"):
        paper = ReferenceACT()
        ours = ACT(decoder_readout="first").state_dict()
    assert sum(parameter.numel() for parameter in paper.parameters()) == 83_897_487
    found, unused = translate({f"model.{n}": v for n, v in paper.state_dict().items()}, ORIGINAL, "paper", DEAD)
    shapes = {name: value.shape for name, value in ours.items()}
    for name in [n for n in shapes if n.startswith("normalizer.")] + ["backbone.pretrained"]:
        del shapes[name]
    assert {name: value.shape for name, value in found.items()} == shapes
    assert sum(value.numel() for value in unused.values()) == 6 * 5_384_832 + 513
    sizes = {"dim": 512, "feedforward": 3200, "encoder_layers": 4, "decoder_layers": 1, "cvae_layers": 4}
    sizes |= {"latent_dim": 32, "chunk_length": 50, "state_dim": 14, "action_dim": 14, "backbone_width": 64}
    assert sizes_of(found, ORIGINAL, "paper") == sizes


def trained(**options):
    torch.manual_seed(0)
    sizes = {"dim": 32, "feedforward": 48, "heads": 4, "encoder_layers": 2, "cvae_layers": 2, "latent_dim": 3}
    more = {"chunk_length": 6, "state_dim": 5, "action_dim": 4, "cameras": TWO}
    policy = ACT(**{**sizes, **more, "precision": "fp32", "backbone_norm": "batch", **options})
    for name, value in policy.named_buffers():
        if name.endswith(("running_var", "running_mean", "_scale", "_shift")) and value.dim() == 1:
            value.copy_(torch.rand_like(value) + 0.5)
    policy.normalizer.fitted.fill_(True)
    return policy.eval()


def test_a_policy_of_ours_drives_the_original_code(images, state):
    policy = trained(decoder_readout="first")
    back = export_act(policy)
    assert any("copies of the first" in note for note in back.notes)
    code = ReferenceACT(**SMALL)
    code.load_state_dict({name.removeprefix("model."): value for name, value in back.weights.items()})
    theirs = executed(code.eval(), back.statistics, images, state)
    torch.testing.assert_close(policy.predict(Observation(images, state)).actions, theirs, atol=1e-5, rtol=0)


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({"decoder_readout": "last", "decoder_layers": 3}, "reads its first decoder layer"),
        ({"uncertainty_head": True}, "drop_refinement"),
        ({"keypoints": 2}, "keypoints"),
        ({"camera_embedding": True}, "camera_embedding"),
        ({"backbone_stem": "unshuffle"}, "backbone_stem"),
        ({"backbone_width": 8}, "backbone_width"),
        ({"backbone_norm": "group"}, "backbone_norm"),
        ({"cvae_layers": 0}, "one setting for both"),
    ],
)
def test_what_the_original_has_no_place_for_is_refused(options, complaint):
    with pytest.raises(ConfigError, match=complaint):
        export_act(trained(**{"decoder_readout": "first", **options}))


def test_refinement_is_left_behind_on_request_and_the_coarse_actions_remain(images, state):
    from ugr_lightning.models.refine.full import Full

    policy = trained(decoder_readout="first", refine=Full(), uncertainty_head=True)
    torch.nn.init.normal_(policy.branch.head.weight)
    with pytest.raises(ConfigError, match="drop_refinement"):
        export_act(policy)
    back = export_act(policy, drop_refinement=True)
    assert any("left behind" in note for note in back.notes)
    again, _ = import_act(back.weights, back.statistics, cameras=TWO, heads=4)
    coarse, refined = policy.predict(Observation(images, state)).coarse, policy.predict(Observation(images, state))
    assert (coarse - refined.actions).abs().max() > 1e-3
    torch.testing.assert_close(again.predict(Observation(images, state)).actions, coarse, atol=1e-5, rtol=0)


def test_foreign_and_damaged_weights_are_refused_by_name(weights, statistics):
    bad = [
        ({**weights, "model.lstm.weight": torch.ones(1)}, "model.lstm.weight"),
        ({k: v for k, v in weights.items() if k != "model.latent_proj.bias"}, "model.latent_proj.bias"),
        ({k: v for k, v in weights.items() if k != "model.query_embed.weight"}, "model.query_embed.weight"),
        ({**weights, "model.action_head.weight": torch.full((4, 32), torch.nan)}, "model.action_head.weight"),
        ({**weights, "model.pos_table": weights["model.pos_table"] + 0.1}, "model.pos_table"),
        ({**weights, "model.input_proj.weight": torch.ones(32, 31, 1, 1)}, "model.input_proj.weight"),
        ({**weights, "model.latent_proj.bias": "six"}, "model.latent_proj.bias"),
        ({**weights, "model.query_embed.weight": torch.ones(1, 1).expand(10**6, 10**6)}, "model.query_embed.weight"),
        ({**weights, "model.query_embed.weight": torch.ones(1, 2**22)}, "tensors of ACT|shape|expected"),
    ]
    for content, complaint in bad:
        with pytest.raises(CheckpointError, match=complaint):
            import_act(content, statistics, cameras=TWO, heads=4)
    with pytest.raises(ConfigError, match="heads"):
        import_act(weights, statistics, cameras=TWO, heads=5)
    with pytest.raises(CheckpointError, match="qpos_mean"):
        import_act(weights, statistics._replace(qpos_mean=torch.zeros(3)), cameras=TWO, heads=4)

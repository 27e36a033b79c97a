"""The backbone and its weight files."""

import subprocess
import sys

import pytest
import torch
from torch import nn
from torch.nn import functional

from ugr_lightning.errors import CheckpointError, ConfigError
from ugr_lightning.models.vision import BasicBlock, ResNet18, convolve, spatial_softmax


def torchvision_like(width: int = 8) -> dict[str, torch.Tensor]:
    """Weights under torchvision's names, with statistics that are not the identity, and a classifier."""
    state = ResNet18(width, norm="batch").state_dict()
    del state["pretrained"]
    for key, value in state.items():
        if "bn" in key or "downsample.1" in key:
            state[key] = torch.rand_like(value.float()) + 0.5
    return {**state, "fc.weight": torch.zeros(10, width * 8), "fc.bias": torch.zeros(10)}


def images(height: int = 64, width: int = 96) -> torch.Tensor:
    return torch.randint(0, 256, (2, height, width, 3), dtype=torch.uint8).permute(0, 3, 1, 2)


def test_has_the_size_and_names_of_resnet18():
    network = ResNet18(norm="batch")
    assert sum(p.numel() for p in network.parameters()) == 11_166_912 + 9_600
    assert network.state_dict()["layer4.0.downsample.0.weight"].shape == (512, 256, 1, 1)
    assert network.state_dict()["layer1.1.bn2.running_var"].shape == (64,)


def test_frozen_normalisation_has_no_parameters():
    assert sum(p.numel() for p in ResNet18(norm="frozen").parameters()) == 11_166_912


@pytest.mark.parametrize("stem", ["standard", "unshuffle"])
def test_strides_are_as_announced(stem):
    network = ResNet18(8, stem, "group")
    _, _, middle, features = network(network.prepare(images()))
    assert middle.shape == (2, 32, 4, 6)
    assert features.shape == (2, 64, 2, 3)


def test_pixels_are_normalised_with_imagenet_statistics():
    x = ResNet18(8, norm="group").prepare(torch.full((1, 3, 4, 4), 255, dtype=torch.uint8))
    assert x[0, :, 0, 0].tolist() == pytest.approx(
        [(1 - m) / s for m, s in ((0.485, 0.229), (0.456, 0.224), (0.406, 0.225))], abs=1e-5
    )
    assert x.is_contiguous(memory_format=torch.channels_last)


def test_unshuffle_stem_keeps_every_pixel_with_its_colour():
    plain, folded = ResNet18(8, norm="group"), ResNet18(8, stem="unshuffle", norm="group")
    pixels = images(8, 12)
    x, y = plain.prepare(pixels), folded.prepare(pixels)  # (2, 3, 8, 12), (2, 48, 2, 3)
    unfolded = y.permute(0, 2, 3, 1).unflatten(3, (4, 4, 3)).transpose(2, 3).flatten(3, 4).flatten(1, 2)
    assert torch.allclose(unfolded.permute(0, 3, 1, 2), x, atol=1e-6)


def test_unshuffle_stem_refuses_a_size_it_cannot_fold():
    with pytest.raises(ConfigError, match="multiples of 4"):
        ResNet18(8, stem="unshuffle", norm="group").prepare(images(30, 40))


def test_frozen_normalisation_folded_equals_batch_norm_in_evaluation(tmp_path):
    torch.save(torchvision_like(), tmp_path / "weights.pth")
    frozen, batch = ResNet18(8, norm="frozen"), ResNet18(8, norm="batch").eval()
    frozen.load_weights(tmp_path / "weights.pth")
    batch.load_weights(tmp_path / "weights.pth")
    x = frozen.prepare(images())
    for ours, theirs in zip(frozen(x), batch(x), strict=True):
        assert torch.allclose(ours, theirs, rtol=1e-4, atol=1e-4)


def test_convolve_applies_an_unfrozen_norm():
    conv, norm = nn.Conv2d(3, 4, 3, bias=False), nn.GroupNorm(1, 4)
    x = torch.randn(1, 3, 8, 8)
    assert torch.equal(convolve(x, conv, norm), norm(conv(x)))


def test_frozen_without_weights_says_what_to_give():
    network = ResNet18(8)
    with pytest.raises(ConfigError, match="backbone_weights"):
        network(network.prepare(images()))


@pytest.mark.parametrize(
    "prefix", ["", "backbones.0.0.body.", "model.backbones.0.0.body.", "backbone.", "model.backbone."]
)
def test_weights_load_from_three_ecosystems(tmp_path, prefix):
    weights = torchvision_like()
    torch.save({prefix + key: value for key, value in weights.items()}, tmp_path / "weights.pth")
    network = ResNet18(8)
    network.load_weights(tmp_path / "weights.pth")
    assert network.pretrained
    for key, value in network.state_dict().items():
        assert key == "pretrained" or torch.equal(value, weights[key])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, r"weights\.pth"),
        (b"not weights", "plain tensors"),
        (nn.Linear(1, 1), "plain tensors"),
        ({"head.weight": torch.zeros(1)}, "ResNet-18"),
    ],
    ids=["missing", "damaged", "would run code", "another network"],
)
def test_a_file_that_is_no_weights_of_a_resnet_is_refused(tmp_path, content, message):
    path = tmp_path / "weights.pth"
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        torch.save(content, path)
    with pytest.raises(CheckpointError, match=message):
        ResNet18(8).load_weights(path)


def test_other_width_is_refused_and_changes_nothing(tmp_path):
    torch.save(torchvision_like(16), tmp_path / "weights.pth")
    network = ResNet18(8)
    before = network.conv1.weight.clone()
    with pytest.raises(CheckpointError, match="backbone_width"):
        network.load_weights(tmp_path / "weights.pth")
    assert torch.equal(network.conv1.weight, before)
    assert not network.pretrained


def test_a_width_that_cannot_be_divided_is_refused():
    with pytest.raises(ConfigError, match="multiple of 8"):
        ResNet18(4)


def test_a_narrow_backbone_learns_from_large_pictures():
    program = """
import torch
from ugr_lightning.models.vision import ResNet18
network = ResNet18(8, norm="batch")
for _ in range(3):
    pictures = torch.randint(0, 256, (6, 3, 240, 320), dtype=torch.uint8)
    network(network.prepare(pictures))[-1].square().mean().backward()
assert all(p.grad.isfinite().all() for p in network.parameters())
"""  # in a process of its own, which the kernel that this is about ends
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_a_narrow_shortcut_leaves_out_what_a_strided_one_does():
    block = BasicBlock(8, 16, 2, "batch").eval()
    x = torch.randn(2, 8, 9, 12)
    shortcut, norm = block.downsample
    expected = norm(functional.conv2d(x, shortcut.weight, stride=2))  # (2, 16, 5, 6)
    block.bn2.weight.data.zero_()
    assert torch.allclose(block(x), expected.relu(), atol=1e-6)


def test_spatial_softmax_finds_a_peak():
    maps = torch.zeros(1, 1, 5, 9)
    maps[0, 0, 4, 2] = 100
    assert spatial_softmax(maps)[0].tolist() == pytest.approx([-0.5, 1.0])

"""ResNet-18 of any width, with torchvision's key names, so that weights of three ecosystems load without renaming."""

import pickle
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from ugr_lightning.errors import CheckpointError, ConfigError

NormName = Literal["frozen", "batch", "group"]
StemName = Literal["standard", "unshuffle"]

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
_PREFIXES = ("", "backbones.0.0.body.", "model.backbones.0.0.body.", "backbone.", "model.backbone.", "policy.backbone.")


class FrozenBatchNorm2d(nn.Module):
    """Batch normalisation whose statistics and affine parameters are constants.

    It is never run by itself: `convolve` folds it into the convolution before it, which saves one pass over the
    feature map forward and two backward.

    Args:
        channels: number of channels.

    Source: FACTS 3.2.
    """

    weight: Tensor
    bias: Tensor
    running_mean: Tensor
    running_var: Tensor

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.register_buffer("weight", torch.ones(channels))
        self.register_buffer("bias", torch.zeros(channels))
        self.register_buffer("running_mean", torch.zeros(channels))
        self.register_buffer("running_var", torch.ones(channels))

    def scale_and_shift(self) -> tuple[Tensor, Tensor]:
        """The affine map that the normalisation amounts to: two (channels,) tensors."""
        scale = self.weight * (self.running_var + 1e-5).rsqrt()
        return scale, self.bias - self.running_mean * scale


def make_norm(norm: NormName, channels: int) -> nn.Module:
    """The normalisation layer of a given name."""
    if norm == "frozen":
        return FrozenBatchNorm2d(channels)
    if norm == "batch":
        return nn.BatchNorm2d(channels)
    return nn.GroupNorm(max(1, channels // 16), channels)


def convolve(x: Tensor, conv: nn.Conv2d, norm: nn.Module) -> Tensor:
    """Convolution followed by its normalisation, as one convolution where the normalisation is frozen."""
    if not isinstance(norm, FrozenBatchNorm2d):
        normalised: Tensor = norm(conv(x))
        return normalised
    scale, shift = norm.scale_and_shift()
    weight = conv.weight * scale[:, None, None, None]
    return functional.conv2d(x, weight, shift, conv.stride, conv.padding)


class BasicBlock(nn.Module):
    """Two 3x3 convolutions with a shortcut.

    Args:
        inputs, outputs: channels.
        stride: of the first convolution and the shortcut.
        norm: name of the normalisation.
    """

    def __init__(self, inputs: int, outputs: int, stride: int, norm: NormName) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False)
        self.bn1 = make_norm(norm, outputs)
        self.conv2 = nn.Conv2d(outputs, outputs, 3, 1, 1, bias=False)
        self.bn2 = make_norm(norm, outputs)
        self.downsample: nn.Sequential | None = None
        if stride != 1 or inputs != outputs:
            shortcut = nn.Conv2d(inputs, outputs, 1, stride, bias=False)
            self.downsample = nn.Sequential(shortcut, make_norm(norm, outputs))

    def forward(self, x: Tensor) -> Tensor:
        """(n, inputs, h, w) to (n, outputs, h / stride, w / stride)."""
        y = functional.relu(convolve(x, self.conv1, self.bn1), inplace=True)
        y = convolve(y, self.conv2, self.bn2)
        if self.downsample is not None:
            conv, norm = self.downsample
            assert isinstance(conv, nn.Conv2d)
            x = convolve(x, conv, norm)
        return functional.relu(y + x, inplace=True)


class ResNet18(nn.Module):
    """The feature extractor that all cameras share.

    Args:
        width: channels of the first stage; 64 is ResNet-18, the last stage has eight times as many.
        stride: total stride, 32 or 16 (then the last stage keeps its resolution).
        stem: `standard` is 7x7 stride 2 and max pooling; `unshuffle` folds 4x4 pixels into channels and convolves 3x3,
            which is several times cheaper on a CPU.
        norm: `frozen` batch norm (needs trained weights), `batch` statistics, or `group`.

    Source: FACTS 3.2, LEARNING_NOTES (normalisation of a backbone trained from scratch).
    """

    pretrained: Tensor
    pixel_mean: Tensor
    pixel_std: Tensor

    def __init__(
        self,
        width: int = 64,
        stride: Literal[16, 32] = 32,
        stem: StemName = "standard",
        norm: NormName = "frozen",
    ) -> None:
        super().__init__()
        if stride not in (16, 32):
            raise ConfigError("backbone_stride", "16 or 32", stride, "Choose one of the two.")
        self.stem, self.norm = stem, norm
        first = (
            nn.Conv2d(3, width, 7, 2, 3, bias=False)
            if stem == "standard"
            else nn.Conv2d(48, width, 3, 1, 1, bias=False)
        )
        self.conv1 = first
        self.bn1 = make_norm(norm, width)
        strides = (1, 2, 2, 2 if stride == 32 else 1)
        inputs = width
        for stage, step in enumerate(strides, start=1):
            outputs = width << (stage - 1)
            blocks = BasicBlock(inputs, outputs, step, norm), BasicBlock(outputs, outputs, 1, norm)
            setattr(self, f"layer{stage}", nn.Sequential(*blocks))
            inputs = outputs
        self.channels, self.middle_channels = width * 8, width * 4
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
        self.register_buffer("pretrained", torch.tensor(False))
        mean, std = (255 * torch.tensor(v).view(1, 3, 1, 1) for v in (IMAGENET_MEAN, IMAGENET_STD))
        self.register_buffer("pixel_mean", mean, persistent=False)
        self.register_buffer("pixel_std", std, persistent=False)
        self.to(memory_format=torch.channels_last)

    def normalise(self, images: Tensor) -> Tensor:
        """Pixels to the scale the network is fed with.

        Args:
            images: (n, 3, H, W) uint8 RGB, 0 .. 255, any memory order.

        Returns:
            (n, 3, H, W) float32, zero mean and unit variance over ImageNet, channels last in memory.
        """
        images = images.contiguous(memory_format=torch.channels_last)  # while it is one byte a value
        return (images.float() - self.pixel_mean) / self.pixel_std  # (n, 3, H, W)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Features of normalised images.

        Args:
            x: (n, 3, H, W) float, normalised.

        Returns:
            (n, 4 width, H/16, W/16) features of the third stage and (n, 8 width, H/stride, W/stride) of the last.

        Raises:
            ConfigError: frozen normalisation without trained weights, or an image size the stem cannot fold.
        """
        if self.norm == "frozen" and not self.pretrained:
            fix = "Give `backbone_weights` a ResNet-18 file, or train from scratch with `backbone_norm: batch`."
            raise ConfigError("backbone_norm: frozen", "trained weights", "random ones", fix)
        if self.stem == "unshuffle":
            height, width = x.shape[2:]
            if height % 4 or width % 4:
                fix = "Change the image size, or use `backbone_stem: standard`."
                raise ConfigError("backbone_stem: unshuffle", "multiples of 4 pixels", f"{height} x {width}", fix)
            x = functional.pixel_unshuffle(x, 4).contiguous(memory_format=torch.channels_last)  # (n, 48, H/4, W/4)
        x = functional.relu(convolve(x, self.conv1, self.bn1), inplace=True)  # (n, width, H/2 or H/4, ...)
        if self.stem == "standard":
            x = functional.max_pool2d(x, 3, 2, 1)  # (n, width, H/4, W/4)
        middle = self.layer3(self.layer2(self.layer1(x)))  # (n, 4 width, H/16, W/16)
        return middle, self.layer4(middle)

    def load_weights(self, path: str | Path) -> None:
        """Fill the backbone with the weights of a local file.

        Args:
            path: a torch file with the key names of torchvision, the original ACT code or lerobot.

        Raises:
            CheckpointError: the file is missing, unsafe, damaged, or of another network.
        """
        weights = _read_backbone(Path(path))
        own = {key: value for key, value in self.state_dict().items() if not _is_bookkeeping(key)}
        for key, value in own.items():
            if key not in weights:
                fix = "Use a ResNet-18, and `backbone_stem: standard` with `backbone_width: 64`."
                raise CheckpointError(f"{path}: {key}", f"shape {tuple(value.shape)}", "no such key", fix)
            if weights[key].shape != value.shape:
                fix = "Set `backbone_width` and `backbone_stem` to those of the file (64 and standard for ResNet-18)."
                got = tuple(weights[key].shape)
                raise CheckpointError(f"{path}: {key}", f"shape {tuple(value.shape)}", got, fix)
        self.load_state_dict({key: weights[key] for key in own}, strict=False)
        self.pretrained.fill_(True)


def _is_bookkeeping(key: str) -> bool:
    return key == "pretrained" or key.endswith("num_batches_tracked")


def _read_backbone(path: Path) -> dict[str, Tensor]:
    """The entries of a file below the prefix at which a ResNet-18 is found, without the prefix."""
    if not path.is_file():
        raise CheckpointError(path, "a file with ResNet-18 weights", "nothing there", "Correct `backbone_weights`.")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, EOFError, ValueError, KeyError, pickle.UnpicklingError) as error:
        fix = "Save the weights again with `torch.save(model.state_dict(), path)`."
        got = f"{type(error).__name__} while reading it"
        raise CheckpointError(path, "a torch file with plain tensors", got, fix) from error
    for wrapper in ("state_dict", "model"):
        if isinstance(content, dict) and isinstance(content.get(wrapper), dict):
            content = content[wrapper]
    if isinstance(content, dict):
        for prefix in _PREFIXES:
            if f"{prefix}layer1.0.conv1.weight" in content:
                return {key[len(prefix) :]: value for key, value in content.items() if key.startswith(prefix)}
    fix = "Use a file with the key names of torchvision, the original ACT code or lerobot."
    raise CheckpointError(path, "a ResNet-18 (`layer1.0.conv1.weight`)", "no such key", fix)

"""ResNet-18 of any width, with torchvision's key names, so that weights of three ecosystems load without renaming."""

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
Fold = Literal[4, 8]
NARROW = 16
"""With fewer inputs, oneDNN's strided 1x1 convolution corrupts memory in training (torch 2.13, AVX2 and AVX-512)."""
_PREFIXES = ("", "backbones.0.0.body.", "model.backbones.0.0.body.", "backbone.", "model.backbone.", "policy.backbone.")


class FrozenBatchNorm2d(nn.Module):
    """Batch normalisation whose statistics and affine parameters are constants.

    It is never run by itself: `convolve` folds it into the convolution before it, which saves one pass over the
    feature map forward and two backward.

    Args:
        channels: number of channels.

    Source: tonyzhaozh/act@742c753, detr/models/backbone.py.
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
        self.leave_out = stride if inputs < NARROW else 1
        if stride != 1 or inputs != outputs:
            shortcut = nn.Conv2d(inputs, outputs, 1, stride // self.leave_out, bias=False)
            self.downsample = nn.Sequential(shortcut, make_norm(norm, outputs))

    def forward(self, x: Tensor) -> Tensor:
        """(n, inputs, h, w) to (n, outputs, h / stride, w / stride)."""
        y = functional.relu(convolve(x, self.conv1, self.bn1), inplace=True)
        y = convolve(y, self.conv2, self.bn2)
        if self.downsample is not None:
            conv, norm = self.downsample
            assert isinstance(conv, nn.Conv2d)
            x = convolve(x[:, :, :: self.leave_out, :: self.leave_out], conv, norm)
        return functional.relu(y.add_(x), inplace=True)  # no layer needs its own output to go back


class ResNet18(nn.Module):
    """The feature extractor that all cameras share.

    Args:
        width: channels of the first stage; 64 is ResNet-18, the last stage has eight times as many.
        stem: `standard` is 7x7 stride 2 and max pooling; `unshuffle` folds squares of pixels into channels and
            convolves 3x3, which is several times cheaper on a CPU.
        norm: `frozen` batch norm (needs trained weights), `batch` statistics, or `group`.
        fold: pixels on a side of such a square; 8 sees pictures of twice the resolution at about the same cost.

    Source: tonyzhaozh/act@742c753, detr/models/backbone.py; docs/recipe.md (`backbone_norm`).
    """

    layer1: nn.Sequential
    layer2: nn.Sequential
    layer3: nn.Sequential
    layer4: nn.Sequential
    pretrained: Tensor
    pixel_scale: Tensor
    pixel_shift: Tensor

    def __init__(
        self,
        width: int = 64,
        stem: StemName = "standard",
        norm: NormName = "frozen",
        fold: Fold = 4,
    ) -> None:
        super().__init__()
        if width < 8 or width % 8:
            raise ConfigError("backbone_width", "a multiple of 8", width, "Use 8, 16, 32 or 64.")
        self.stem, self.norm, self.fold = stem, norm, fold
        if stem == "standard":
            self.conv1 = nn.Conv2d(3, width, 7, 2, 3, bias=False)
        else:
            self.conv1 = nn.Conv2d(3 * fold * fold, width, 3, 1, 1, bias=False)
        self.bn1 = make_norm(norm, width)
        inputs = width
        for stage, stride in enumerate((1, 2, 2, 2), start=1):
            outputs = width << (stage - 1)
            blocks = BasicBlock(inputs, outputs, stride, norm), BasicBlock(outputs, outputs, 1, norm)
            self.add_module(f"layer{stage}", nn.Sequential(*blocks))
            inputs = outputs
        self.channels, self.middle_channels = width * 8, width * 4
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
                module.weight.data = module.weight.data.contiguous(memory_format=torch.channels_last)
        self.register_buffer("pretrained", torch.tensor(False))
        mean, std = (255 * torch.tensor(v).view(1, 3, 1, 1) for v in (IMAGENET_MEAN, IMAGENET_STD))
        copies = (1, self.conv1.in_channels // 3, 1, 1)
        self.register_buffer("pixel_scale", (1 / std).repeat(copies), persistent=False)
        self.register_buffer("pixel_shift", (-mean / std).repeat(copies), persistent=False)

    def prepare(self, images: Tensor) -> Tensor:
        """Pixels as the first convolution wants them: folded where the stem folds, and normalised.

        Args:
            images: (n, 3, H, W) uint8 RGB, 0 .. 255; channels last in memory costs no copy.

        Returns:
            (n, 3, H, W) or (n, 3 fold^2, H/fold, W/fold) float32, zero mean and unit variance over ImageNet,
            channels last.

        Raises:
            ConfigError: an image size that the stem cannot fold.
        """
        pixels = images.permute(0, 2, 3, 1)  # (n, H, W, 3)
        if self.stem == "unshuffle":  # while a value is one byte
            height, width = pixels.shape[1:3]
            fold = self.fold
            if height % fold or width % fold:
                fix = "Change the image size, or use `backbone_stem: standard`."
                raise ConfigError("backbone_stem: unshuffle", f"multiples of {fold}", f"{height} x {width}", fix)
            pixels = pixels.unflatten(2, (-1, fold)).unflatten(1, (-1, fold))  # (n, H/fold, fold, W/fold, fold, 3)
            pixels = pixels.transpose(2, 3).flatten(3)  # (n, H/fold, W/fold, 3 fold^2)
        x = pixels.contiguous().permute(0, 3, 1, 2).float()  # (n, 3 or 3 fold^2, ...)
        return torch.addcmul(self.pixel_shift, x, self.pixel_scale)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Features of prepared images.

        Args:
            x: (n, 3 or 3 fold^2, ...) float, from `prepare`.

        Returns:
            (n, width 2^i, ...) features of the stages i = 0 .. 3: a quarter of the picture's resolution (an eighth
            where 8x8 pixels are folded), then half as fine each.

        Raises:
            ConfigError: frozen normalisation without trained weights.
        """
        if self.norm == "frozen" and not torch.compiler.is_exporting() and not self.pretrained:
            fix = "Give `backbone_weights` a ResNet-18 file, or train from scratch with `backbone_norm: batch`."
            raise ConfigError("backbone_norm: frozen", "trained weights", "random ones", fix)
        x = functional.relu(convolve(x, self.conv1, self.bn1), inplace=True)  # (n, width, H/2 or H/fold, ...)
        if self.stem == "standard":
            x = functional.max_pool2d(x, 3, 2, 1)  # (n, width, H/4, W/4)
        first = self.layer1(x)
        second = self.layer2(first)
        third = self.layer3(second)
        return first, second, third, self.layer4(third)

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


def spatial_softmax(maps: Tensor) -> Tensor:
    """Where each map is high: the mean position under its softmax.

    Args:
        maps: (n, keypoints, h, w).

    Returns:
        (n, 2 keypoints) float32, x then y of each, -1 .. 1 over the image.
    """
    weights = maps.float().flatten(2).softmax(-1).unflatten(2, maps.shape[2:])  # (n, keypoints, h, w)
    y, x = (torch.linspace(-1, 1, n, device=maps.device) for n in maps.shape[2:])
    return torch.stack([weights.sum(2) @ x, weights.sum(3) @ y], dim=-1).flatten(1)  # (n, 2 keypoints)


def _is_bookkeeping(key: str) -> bool:
    return key == "pretrained" or key.endswith("num_batches_tracked")


def _read_backbone(path: Path) -> dict[str, Tensor]:
    """The entries of a file below the prefix at which a ResNet-18 is found, without the prefix."""
    if not path.is_file():
        raise CheckpointError(path, "a file with ResNet-18 weights", "nothing there", "Correct `backbone_weights`.")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except (PermissionError, MemoryError):  # a file that is whole
        raise
    except Exception as error:  # a damaged file fails in as many ways as there are opcodes
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

"""The network of the original ACT code, restated with plain torch: a yardstick for speed and for parity.

It computes what that code computes, in its order and under its parameter names: one backbone call per camera, frozen
batch norm as operations of its own, attention through `torch.nn.MultiheadAttention` with its weights returned, all
seven decoder layers although only the first is read, float32 and NCHW throughout. Nothing of the package is used here,
so that comparing the two proves something. Source: tonyzhaozh/act@742c753, detr/models and policy.py.
"""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional


def sinusoids(positions: Tensor, dim: int) -> Tensor:
    """Positions (n,) as sines and cosines in turns, (n, dim) float32."""
    index = torch.arange(dim, dtype=torch.float64)
    angles = positions.double()[:, None] / 10000 ** (2 * (index // 2) / dim)  # (n, dim)
    return torch.where(index % 2 == 0, angles.sin(), angles.cos()).float()


def sine_map(height: int, width: int, dim: int) -> Tensor:
    """(h, w, D): y in the first half of the dimensions, x in the second, each counted from 1 to 2 pi."""
    y, x = (sinusoids(2 * math.pi * torch.arange(1, n + 1) / (n + 1e-6), dim // 2) for n in (height, width))
    return torch.cat([y[:, None].expand(-1, width, -1), x.expand(height, -1, -1)], dim=2)


class SeparateFrozenNorm(nn.Module):
    """Batch norm with fixed statistics, applied after the convolution instead of being folded into it."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        for name, value in (("weight", 1.0), ("bias", 0.0), ("running_mean", 0.0), ("running_var", 1.0)):
            self.register_buffer(name, torch.full((channels,), value))

    def forward(self, x: Tensor) -> Tensor:
        """(n, channels, h, w) to the same."""
        weight, bias, mean, variance = (value.view(1, -1, 1, 1) for value in self.buffers())  # (1, channels, 1, 1) each
        scale = weight * (variance + 1e-5).rsqrt()
        return x * scale + (bias - mean * scale)


class ReferenceBlock(nn.Module):
    """A basic block of ResNet-18, every operation by itself."""

    def __init__(self, inputs: int, outputs: int, stride: int) -> None:
        super().__init__()
        self.conv1, self.bn1 = nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False), SeparateFrozenNorm(outputs)
        self.conv2, self.bn2 = nn.Conv2d(outputs, outputs, 3, 1, 1, bias=False), SeparateFrozenNorm(outputs)
        self.downsample: nn.Sequential | None = None
        if inputs != outputs:
            conv = nn.Conv2d(inputs, outputs, 1, stride, bias=False)
            self.downsample = nn.Sequential(conv, SeparateFrozenNorm(outputs))

    def forward(self, x: Tensor) -> Tensor:
        """(n, inputs, h, w) to (n, outputs, h / stride, w / stride)."""
        y = functional.relu(self.bn1(self.conv1(x)), inplace=True)
        shortcut = x if self.downsample is None else self.downsample(x)
        return functional.relu(self.bn2(self.conv2(y)) + shortcut, inplace=True)


class ReferenceResNet18(nn.Module):
    """ResNet-18 without its classifier; parameters are named as in torchvision."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.conv1, self.bn1 = nn.Conv2d(3, width, 7, 2, 3, bias=False), SeparateFrozenNorm(width)
        inputs = width
        for stage, stride in enumerate((1, 2, 2, 2), start=1):
            outputs = width << (stage - 1)
            blocks = ReferenceBlock(inputs, outputs, stride), ReferenceBlock(outputs, outputs, 1)
            self.add_module(f"layer{stage}", nn.Sequential(*blocks))
            inputs = outputs

    def forward(self, x: Tensor) -> Tensor:
        """(n, 3, H, W) float32 to (n, 8 width, H/32, W/32)."""
        x = functional.max_pool2d(functional.relu(self.bn1(self.conv1(x)), inplace=True), 3, 2, 1)
        for stage in range(1, 5):
            x = self.get_submodule(f"layer{stage}")(x)
        return x


class ReferenceLayer(nn.Module):
    """A post-norm DETR layer: an encoder layer, or with `cross` a decoder layer. Sequence first, as in that code."""

    def __init__(self, dim: int, heads: int, feedforward: int, dropout: float, cross: bool) -> None:
        super().__init__()
        self.self_attn = nn.MultiheadAttention(dim, heads, dropout)
        self.linear1, self.linear2 = nn.Linear(dim, feedforward), nn.Linear(feedforward, dim)
        self.norm1, self.norm2 = nn.LayerNorm(dim), nn.LayerNorm(dim)
        self.multihead_attn = nn.MultiheadAttention(dim, heads, dropout) if cross else None
        self.norm3 = nn.LayerNorm(dim) if cross else None
        self.dropout = nn.Dropout(dropout)

    def forward(
        self,
        x: Tensor,
        position: Tensor,
        memory: Tensor | None = None,
        memory_position: Tensor | None = None,
        padding: Tensor | None = None,
    ) -> Tensor:
        """(N, B, D) to (N, B, D); `position` (N, 1, D), `memory` (M, B, D), `padding` (B, N) True where hidden."""
        query = x + position
        x = self.norm1(x + self.dropout(self.self_attn(query, query, x, key_padding_mask=padding)[0]))
        last_norm = self.norm2
        if self.multihead_attn is not None and self.norm3 is not None:
            assert memory is not None
            assert memory_position is not None
            seen = self.multihead_attn(x + position, memory + memory_position, memory)[0]  # (N, B, D)
            x, last_norm = self.norm2(x + self.dropout(seen)), self.norm3
        return last_norm(x + self.dropout(self.linear2(self.dropout(functional.relu(self.linear1(x))))))


class ReferenceStack(nn.Module):
    """Layers under one name; those of a decoder with the norm that reads them out."""

    def __init__(self, count: int, dim: int, heads: int, feedforward: int, dropout: float, cross: bool = False) -> None:
        super().__init__()
        self.layers = nn.ModuleList(ReferenceLayer(dim, heads, feedforward, dropout, cross) for _ in range(count))
        self.norm = nn.LayerNorm(dim) if cross else None


class ReferenceACT(nn.Module):
    """The network of the original ACT code. Its arguments are those of our `ACT`, at the paper's sizes."""

    def __init__(
        self,
        dim: int = 512,
        heads: int = 8,
        feedforward: int = 3200,
        encoder_layers: int = 4,
        cvae_layers: int = 4,
        decoder_layers: int = 7,
        chunk_length: int = 50,
        state_dim: int = 14,
        action_dim: int = 14,
        latent_dim: int = 32,
        backbone_width: int = 64,
        dropout: float = 0.1,
    ) -> None:
        super().__init__()
        sizes, self.latent_dim = (dim, heads, feedforward, dropout), latent_dim
        self.encoder = ReferenceStack(cvae_layers, *sizes)  # of the CVAE
        self.transformer, backbone = nn.Module(), nn.Module()
        self.transformer.encoder = ReferenceStack(encoder_layers, *sizes)
        self.transformer.decoder = ReferenceStack(decoder_layers, *sizes, cross=True)
        backbone.body = ReferenceResNet18(backbone_width)
        self.backbones = nn.ModuleList([nn.Sequential(backbone)])
        self.input_proj = nn.Conv2d(8 * backbone_width, dim, 1)
        self.input_proj_robot_state = nn.Linear(state_dim, dim)
        self.action_head, self.is_pad_head = nn.Linear(dim, action_dim), nn.Linear(dim, 1)
        self.query_embed, self.additional_pos_embed = nn.Embedding(chunk_length, dim), nn.Embedding(2, dim)
        self.cls_embed = nn.Embedding(1, dim)
        self.encoder_action_proj, self.encoder_joint_proj = nn.Linear(action_dim, dim), nn.Linear(state_dim, dim)
        self.latent_proj, self.latent_out_proj = nn.Linear(dim, 2 * latent_dim), nn.Linear(latent_dim, dim)
        self.register_buffer("pos_table", sinusoids(torch.arange(2 + chunk_length), dim)[None])
        self.pos_table: Tensor

    def forward(self, images: Tensor, state: Tensor, latent: Tensor | None = None) -> Tensor:
        """Predict a chunk.

        Args:
            images: (B, V, 3, H, W) float32, 0 .. 1.
            state: (B, S) float32, normalised.
            latent: (B, latent) float32; None for zeros.

        Returns:
            (B, K, A) float32, normalised.
        """
        batch, cameras = images.shape[:2]
        mean, std = (images.new_tensor(of).view(3, 1, 1) for of in ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)))
        body = self.backbones[0].get_submodule("0.body")
        seen = [self.input_proj(body((images[:, camera] - mean) / std)) for camera in range(cameras)]
        features = torch.cat(seen, dim=3)  # (B, D, h, V w), cameras side by side
        height, width = seen[0].shape[2:]
        positions = sine_map(height, width, features.shape[1]).repeat(1, cameras, 1)  # (h, V w, D)
        latent = images.new_zeros(batch, self.latent_dim) if latent is None else latent
        front = torch.stack([self.latent_out_proj(latent), self.input_proj_robot_state(state)])  # (2, B, D)
        x = torch.cat([front, features.flatten(2).permute(2, 0, 1)])  # (N, B, D)
        position = torch.cat([self.additional_pos_embed.weight, positions.flatten(0, 1)])[:, None]  # (N, 1, D)
        for layer in self.transformer.get_submodule("encoder.layers").children():
            x = layer(x, position)
        queries = self.query_embed.weight[:, None]  # (K, 1, D)
        hidden = torch.zeros_like(queries).repeat(1, batch, 1)  # (K, B, D)
        norm, read = self.transformer.get_submodule("decoder.norm"), []
        for layer in self.transformer.get_submodule("decoder.layers").children():
            hidden = layer(hidden, queries, x, position)
            read.append(norm(hidden))
        actions: Tensor = self.action_head(torch.stack(read).transpose(1, 2)[0])  # (B, K, A)
        return actions

    def encode(self, state: Tensor, actions: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log-variance, (B, latent) each, of the posterior of a demonstrated chunk (B, K, A)."""
        cls = self.cls_embed.weight.expand(1, len(state), -1)  # (1, B, D)
        parts = [cls, self.encoder_joint_proj(state)[None], self.encoder_action_proj(actions).transpose(0, 1)]
        x = torch.cat(parts)  # (2 + K, B, D)
        padding = torch.cat([valid.new_zeros(len(valid), 2), ~valid], dim=1)  # (B, 2 + K)
        for layer in self.encoder.layers:
            x = layer(x, self.pos_table.transpose(0, 1), padding=padding)
        mean, log_variance = self.latent_proj(x[0]).chunk(2, dim=-1)
        return mean, log_variance

    def loss(self, images: Tensor, state: Tensor, actions: Tensor, valid: Tensor) -> Tensor:
        """L1 over everything, padding included, plus 10 times the KL term; arguments as in `forward` and `encode`."""
        mean, log_variance = self.encode(state, actions, valid)
        latent = mean + (log_variance / 2).exp() * torch.randn_like(mean)  # (B, latent)
        error = functional.l1_loss(self(images, state, latent), actions, reduction="none")  # (B, K, A)
        kl = -0.5 * (1 + log_variance - mean.square() - log_variance.exp())  # (B, latent)
        return (error * valid[..., None]).mean() + 10 * kl.sum(1).mean()

"""ACT as lerobot publishes it, from its equations and with plain torch alone, and the original's network made small.

Nothing of the package's own policies is used here: it is the independent side of the import tests. Source:
huggingface/lerobot@7427f31, src/lerobot/policies/act.
"""

import torch
from torch import Tensor, nn

from ugr_lightning.speed.reference_act import ReferenceResNet18, ReferenceStack, sine_map, sinusoids

SMALL = {"dim": 32, "heads": 4, "feedforward": 48, "encoder_layers": 2, "cvae_layers": 2, "chunk_length": 6}
SMALL |= {"state_dim": 5, "action_dim": 4, "latent_dim": 3}
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


class LeRobotACT(nn.Module):
    def __init__(
        self, dim, heads, feedforward, encoder_layers, cvae_layers, decoder_layers, chunk_length, state_dim, action_dim,
        latent_dim,
    ) -> None:  # fmt: skip
        super().__init__()
        sizes = (dim, heads, feedforward, 0.1)
        self.latent_dim = latent_dim
        self.vae_encoder = ReferenceStack(cvae_layers, *sizes)
        self.vae_encoder_cls_embed = nn.Embedding(1, dim)
        self.vae_encoder_robot_state_input_proj = nn.Linear(state_dim, dim)
        self.vae_encoder_action_input_proj = nn.Linear(action_dim, dim)
        self.vae_encoder_latent_output_proj = nn.Linear(dim, 2 * latent_dim)
        self.register_buffer("vae_encoder_pos_enc", sinusoids(torch.arange(2 + chunk_length), dim)[None])
        self.backbone = ReferenceResNet18(64)
        self.encoder = ReferenceStack(encoder_layers, *sizes)
        self.decoder = ReferenceStack(decoder_layers, *sizes, cross=True)
        self.encoder_robot_state_input_proj = nn.Linear(state_dim, dim)
        self.encoder_latent_input_proj = nn.Linear(latent_dim, dim)
        self.encoder_img_feat_input_proj = nn.Conv2d(8 * 64, dim, 1)
        self.encoder_1d_feature_pos_embed = nn.Embedding(2, dim)
        self.decoder_pos_embed = nn.Embedding(chunk_length, dim)
        self.action_head = nn.Linear(dim, action_dim)

    def forward(self, images: list[Tensor], state: Tensor) -> Tensor:
        """Normalised images (B, 3, H, W) of each camera and state (B, S) to normalised actions (B, K, A)."""
        tokens = [self.encoder_latent_input_proj(torch.zeros(len(state), self.latent_dim))[None]]
        tokens.append(self.encoder_robot_state_input_proj(state)[None])
        positions = [self.encoder_1d_feature_pos_embed.weight]
        for image in images:  # one camera after the other
            features = self.encoder_img_feat_input_proj(self.backbone(image))  # (B, D, h, w)
            tokens.append(features.flatten(2).permute(2, 0, 1))
            positions.append(sine_map(*features.shape[2:], features.shape[1]).flatten(0, 1))
        memory, position = torch.cat(tokens), torch.cat(positions)[:, None]  # (N, B, D), (N, 1, D)
        for layer in self.encoder.layers:
            memory = layer(memory, position)
        queries = self.decoder_pos_embed.weight[:, None].repeat(1, len(state), 1)  # (K, B, D)
        x = torch.zeros_like(queries)
        for layer in self.decoder.layers:
            x = layer(x, queries, memory, position)
        return self.action_head(self.decoder.norm(x).transpose(0, 1))  # the last layer's


def small(kind: type[nn.Module], decoder_layers: int) -> nn.Module:
    """A small network in which every number matters: biases and frozen statistics are away from 0 and 1."""
    torch.manual_seed(0)
    module = kind(**SMALL, decoder_layers=decoder_layers)
    for name, value in [*module.named_parameters(), *module.named_buffers()]:
        if name.endswith("running_var"):
            value.data.uniform_(0.5, 2.0)
        elif value.dim() == 1:
            value.data.add_(0.3 * torch.randn_like(value))
    return module.eval()


def seen() -> tuple[Tensor, Tensor]:
    """What two cameras see, (B, V, 3, H, W) uint8, and a state (B, S) in robot units; two samples."""
    draw = torch.Generator().manual_seed(1)
    return torch.randint(256, (2, 2, 3, 64, 96), dtype=torch.uint8, generator=draw), torch.randn(2, 5, generator=draw)

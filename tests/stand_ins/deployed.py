"""Checkpoints to evaluate, of policies whose output is known or at least depends on everything they see."""

import torch
from fake_simulator import HOME

from ugr_lightning.contract import Chunk, ChunkPolicy, Observation, Statistics
from ugr_lightning.models.act import ACT
from ugr_lightning.models.checkpoint import save_policy
from ugr_lightning.models.keyframes import KeyframeSettings

TINY = {"dim": 16, "feedforward": 32, "heads": 2, "encoder_layers": 1, "decoder_layers": 1, "cvae_layers": 0}
TINY |= {"backbone_width": 8, "backbone_norm": "batch", "precision": "fp32", "chunk_length": 10, "latent_dim": 4}


class Recaller(ChunkPolicy):
    """Commands a sum over the last three observations, oldest weighted least, so that a missed one shows."""

    observation_steps = 3

    def __init__(self, chunk_length: int = 6) -> None:
        super().__init__()
        self.cameras, self.chunk_length, self.state_dim, self.action_dim = ("cam_high",), chunk_length, 14, 14

    def set_statistics(self, statistics: Statistics) -> None:
        pass

    def losses(self, batch):
        raise NotImplementedError

    def predict(self, observation: Observation) -> Chunk:
        weights = torch.tensor([0.01, 0.1, 1.0])
        bright = (observation.images.float().mean((2, 3, 4, 5)) * weights).sum(1) / 1000  # (B, T, V, 3, H, W) -> (B,)
        ahead = 0.01 * torch.arange(1, self.chunk_length + 1)  # (K,)
        actions = torch.from_numpy(HOME).expand(len(bright), self.chunk_length, 14).clone()  # (B, K, A)
        actions[..., 0] = bright[:, None] + ahead + 0.5 * (observation.state[:, :, 0] * weights).sum(1)[:, None]
        return Chunk(actions)


def tiny_act(fitted: bool = True, **changes) -> ACT:
    """An untrained ACT around the home pose."""
    torch.manual_seed(0)
    policy = ACT(**{**TINY, **changes})
    if fitted:
        home, spread = torch.from_numpy(HOME), torch.full((14,), 0.2)
        keyframes = {"keyframe_mean": torch.full((2, 3), 0.1), "keyframe_std": torch.ones(2, 3)}
        policy.set_statistics(Statistics(*[home, spread, home - 1, home + 1] * 2, **keyframes))
    return policy.eval()


def looking_act(**changes) -> ACT:
    """One that is told where keyframes are, and so needs the calibration of the cameras."""
    return tiny_act(keyframes=KeyframeSettings(channels=8, zoom=8, zoom_levels=2), keypoints=1, **changes)


def save(policy: ChunkPolicy, path, **data):
    """Write what `ugr fit` would have written."""
    about = {"task": "click_alarmclock", "setting": "demo_clean", "state": "commanded", "image_size": (30, 40)}
    save_policy(path, policy, about | data)
    return path

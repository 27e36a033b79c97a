"""How chunks are made noisy for training, and made from noise at run time, by the schedulers of `diffusers`."""

from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor

from ugr_lightning.errors import ConfigError, require_extra

SamplerName = Literal["ddpm", "ddim"]
PredictionName = Literal["epsilon", "sample"]

Denoiser = Callable[[Tensor, Tensor], Tensor]
"""From a noisy chunk (B, L, A) and its diffusion steps (B,) to the prediction (B, L, A)."""


class NoiseProcess:
    """A cosine noise schedule with the sampler that reverses it.

    Args:
        steps: diffusion steps of training.
        sampler: `ddpm` adds fresh noise in every step; `ddim` adds none and needs few steps.
        sampling_steps: diffusion steps of sampling, at most `steps`.
        prediction: what the network predicts: the noise (`epsilon`) or the clean `sample`.

    Raises:
        ConfigError: more sampling steps than diffusion steps, an unknown name, or diffusers is not installed.

    Source: RoboTwin-Platform/RoboTwin@13c3c47, policy/DP/diffusion_policy/config/robot_dp_14.yaml.
    """

    def __init__(
        self,
        steps: int = 100,
        sampler: SamplerName = "ddpm",
        sampling_steps: int = 100,
        prediction: PredictionName = "epsilon",
    ) -> None:
        require_extra("Diffusion Policy", "diffusion", "diffusers.schedulers.scheduling_ddim")
        # Imported here: diffusers takes seconds, and the other policies do without it.
        from diffusers.schedulers.scheduling_ddim import DDIMScheduler
        from diffusers.schedulers.scheduling_ddpm import DDPMScheduler

        if not 1 <= sampling_steps <= steps:
            fix = "Change `sampling_steps` or `diffusion_steps`."
            raise ConfigError("sampling_steps", f"1 to {steps} (diffusion_steps)", sampling_steps, fix)
        if sampler not in ("ddpm", "ddim"):
            raise ConfigError("sampler", "`ddpm` or `ddim`", sampler, "Correct the name.")
        if prediction not in ("epsilon", "sample"):
            raise ConfigError("prediction", "`epsilon` or `sample`", prediction, "Correct the name.")
        self.steps, self.prediction = steps, prediction
        common = {
            "num_train_timesteps": steps,
            "beta_schedule": "squaredcos_cap_v2",
            "prediction_type": prediction,
            "clip_sample": True,
            "timestep_spacing": "trailing",  # starts at the noisiest step, as sampling starts from pure noise
        }
        self.scheduler = DDPMScheduler(**common) if sampler == "ddpm" else DDIMScheduler(**common)
        self.scheduler.set_timesteps(sampling_steps)

    def corrupt(self, clean: Tensor, noise: Tensor, step: Tensor) -> tuple[Tensor, Tensor]:
        """Make clean chunks noisy.

        Args:
            clean: (B, L, A) chunks, -1 .. 1.
            noise: (B, L, A) standard normal.
            step: (B,) int64 diffusion steps, 0 for the least noise.

        Returns:
            (B, L, A) noisy chunks, and (B, L, A) what the network has to predict from them.
        """
        noisy = self.scheduler.add_noise(clean, noise, step)
        return noisy, noise if self.prediction == "epsilon" else clean

    def sample(self, denoise: Denoiser, shape: tuple[int, int, int], seed: int, device: torch.device) -> Tensor:
        """Chunks made from noise; rows with equal predictions come out equal, in a batch of any size.

        Args:
            denoise: the network.
            shape: (B, L, A).
            seed: of the noise, which is the same for every row, and on every device.
            device: where the network is.

        Returns:
            (B, L, A) float32.
        """
        from diffusers.utils.torch_utils import randn_tensor

        generators = [torch.Generator().manual_seed(seed) for _ in range(shape[0])]  # one per row
        x = randn_tensor(shape, generator=generators, device=device, dtype=torch.float32)  # (B, L, A)
        for step in self.scheduler.timesteps.tolist():
            prediction = denoise(x, torch.full(shape[:1], step, device=device))  # (B, L, A)
            x = self.scheduler.step(prediction, step, x, generator=generators, return_dict=False)[0]
        return x

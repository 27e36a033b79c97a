"""Trains and asks every kind of policy on a device that is not the CPU; prints what went wrong, by policy, as JSON.

The device does not exist: its tensors have a shape and a place and no numbers, and, as on a GPU, an operation refuses
tensors of two places. A process of its own, because torch keeps a device that it has been told of.
"""

import json
import sys
import traceback
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch
import yaml
from torch import nn
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils import backend_registration

from ugr_lightning.blueprint import rebuild
from ugr_lightning.cli.parsing.config import expand_includes
from ugr_lightning.contract import Batch, ChunkPolicy, Keyframes, Statistics
from ugr_lightning.models.act import ACT
from ugr_lightning.models.diffusion import DiffusionPolicy
from ugr_lightning.models.keyframes import KeyframeSettings
from ugr_lightning.models.refine.selector import Selector
from ugr_lightning.models.refine.uncertainty import Uncertainty

DEVICE = "gadget"
CONFIGS = Path(__file__).parents[2] / "configs"
ACT_PATH = "ugr_lightning.models.act.ACT"
SMALL = {"dim": 32, "feedforward": 32, "heads": 2, "encoder_layers": 1, "cvae_layers": 1, "backbone_width": 8}


class Gadget(backend_registration._DummyBackendModule):
    """What torch wants to know of a device."""

    def get_amp_supported_dtype(self):
        return [torch.bfloat16]

    def is_initialized(self):
        return True

    def device_count(self):
        return 1

    def current_device(self):
        return 0


class Stray(Selector):
    """A mistake to be found: it chooses on the CPU, wherever the policy is."""

    def __init__(self):
        super().__init__()

    def budget(self, chunk_length):
        return chunk_length

    def select(self, log_variance, valid, training):
        return torch.ones(valid.shape, dtype=torch.bool) & valid


def configured(path: Path) -> ChunkPolicy:
    """The policy of a config, smaller."""
    chosen: dict[str, Any] = {"class_path": ACT_PATH, "init_args": {}}
    for part in expand_includes(["--config", str(path)])[1::2]:
        found = yaml.safe_load(Path(part).read_text()).get("model", {}).get("policy", {})
        if found.get("class_path", chosen["class_path"]) != chosen["class_path"]:
            chosen = {"class_path": found["class_path"], "init_args": {}}
        chosen["init_args"] |= found.get("init_args", {})
    options = chosen["init_args"] | {"precision": "fp32"} | (SMALL if chosen["class_path"] == ACT_PATH else {})
    return rebuild({"class_path": chosen["class_path"], "init_args": options})


def act(**options: Any) -> ACT:
    return ACT(precision="fp32", **SMALL, **options)


POLICIES: dict[str, Callable[[], ChunkPolicy]] = {
    **{path.stem: partial(configured, path) for path in [*CONFIGS.glob("*.yaml"), *CONFIGS.glob("controls/*.yaml")]},
    "jitter": lambda: act(refine=Uncertainty(), color_jitter=0.2),
    "a second look": lambda: act(
        keyframes=KeyframeSettings(zoom=16, zoom_levels=2), mirror=0.5, image_shift=4, color_jitter=0.2
    ),
    "diffusion with a history": lambda: DiffusionPolicy(
        diffusion_steps=2, sampling_steps=2, unet_widths=(16, 32), backbone_width=8, precision="fp32"
    ),
    "diffusion with keyframes": lambda: DiffusionPolicy(
        diffusion_steps=2,
        sampling_steps=2,
        unet_widths=(16, 32),
        backbone_width=8,
        keyframes=KeyframeSettings(zoom=16),
        precision="fp32",
    ),
    "stray": lambda: act(refine=Stray()),
}


def placed(tensor: torch.Tensor) -> torch.Tensor:
    return torch.empty(tensor.shape, dtype=tensor.dtype, device=DEVICE)


def move(policy: ChunkPolicy, mode: FakeTensorMode) -> None:
    """What `.to` does; torch's own would need the device's memory."""
    if isinstance(policy, DiffusionPolicy):  # diffusers keeps its table on the CPU and moves it itself
        scheduler = policy.process.scheduler
        scheduler.alphas_cumprod = mode.from_tensor(scheduler.alphas_cumprod)
        scheduler.previous_timestep = lambda step: step - 1  # it looks for it among numbers
    for module in policy.modules():
        for name, buffer in module.named_buffers(recurse=False):
            module._buffers[name] = placed(buffer)
        for name, parameter in module.named_parameters(recurse=False):
            module._parameters[name] = nn.Parameter(placed(parameter), parameter.requires_grad)


def new_tensor(self: torch.Tensor, data: Any) -> torch.Tensor:
    """What torch's own does; it would need the device's memory."""
    return torch.empty(np.shape(data), dtype=self.dtype, device=self.device)


def lessons(policy: ChunkPolicy, size: int = 4) -> Batch:
    time = (size,) if policy.observation_steps == 1 else (size, policy.observation_steps)
    steps, cameras = policy.chunk_length, len(policy.cameras)
    return Batch(
        images=torch.zeros(*time, cameras, 3, 64, 96, dtype=torch.uint8, device=DEVICE),
        state=torch.zeros(*time, policy.state_dim, device=DEVICE),
        actions=torch.zeros(size, steps, policy.action_dim, device=DEVICE),
        valid=torch.ones(size, steps, dtype=torch.bool, device=DEVICE),
        episode=torch.zeros(size, dtype=torch.int64, device=DEVICE),
        step=torch.zeros(size, dtype=torch.int64, device=DEVICE),
        projection=torch.zeros(*time, cameras, 3, 4, device=DEVICE),
        keyframes=Keyframes(
            torch.zeros(size, 2, 3, device=DEVICE),
            torch.zeros(size, 2, 6, device=DEVICE),
            torch.zeros(size, 2, dtype=torch.int64, device=DEVICE),
        ),
    )


def train_and_ask(policy: ChunkPolicy) -> None:
    zero, one = torch.zeros(14), torch.ones(14)
    tools = torch.zeros(2, 3), torch.ones(2, 3)
    policy.set_statistics(Statistics(zero, one, -one, one, zero, one, -one, one, *tools))
    quick = policy.for_inference()
    mode = FakeTensorMode(allow_non_fake_inputs=True)
    truth = mock.patch.object(torch.Tensor, "__bool__", return_value=True)  # there are no numbers to look at
    with mode, truth, mock.patch.object(torch.Tensor, "new_tensor", new_tensor):
        move(policy, mode)
        move(quick, mode)
        batch = lessons(policy)
        policy.train()
        loss = policy.losses(batch)["loss"]
        loss.backward()
        places = {loss.device.type}
        places |= {parameter.grad.device.type for parameter in policy.parameters() if parameter.grad is not None}
        for each in (policy.eval(), quick):
            chunk = each.predict(batch.observation)
            places |= {part.device.type for part in chunk if part is not None}
    assert places == {DEVICE}, places


def main() -> None:
    backend_registration._setup_privateuseone_for_python_backend(DEVICE, backend_module=Gadget())
    found = {}
    for name, build in POLICIES.items():
        try:
            train_and_ask(build())
            found[name] = ""
        except Exception as error:
            place = traceback.extract_tb(error.__traceback__)
            ours = [f"{frame.filename.rpartition('/')[2]}:{frame.lineno}" for frame in place if "ugr" in frame.filename]
            found[name] = f"{' > '.join(ours)}: {type(error).__name__}: {error}"
    json.dump(found, sys.stdout)


if __name__ == "__main__":
    main()

"""Where a policy computes."""

import torch

from ugr_lightning.errors import ConfigError


def chosen_device(name: str) -> torch.device:
    """The device that a user means.

    Args:
        name: `auto`, which is the GPU where there is one, else the CPU; or a name of torch's, such as `cuda:1`.

    Raises:
        ConfigError: this machine has no such device.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        return torch.empty(0, device=name).device
    except (RuntimeError, AssertionError) as error:
        fix = "Use `auto`, `cpu` or `cuda:0`."
        raise ConfigError("device", "a device of this machine", name, fix) from error

"""The adapter folder that XPolicyLab's scripts expect (XPolicyLab/XPolicyLab@7198143, policy/ACT)."""

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import yaml

from ugr_lightning.bridges.adapter_files import write_adapter_folder
from ugr_lightning.bridges.xpolicylab.model import XPolicyModel
from ugr_lightning.errors import ConfigError

write_adapter = partial(write_adapter_folder, "xpolicylab", XPolicyModel)


def read_deployment(folder: Path, overrides: Mapping[str, Any]) -> dict[str, Any]:
    """The settings of an adapter folder.

    Args:
        folder: with a `deploy.yml`.
        overrides: settings that win; None leaves the file's.

    Raises:
        ConfigError: no such file, or it is no mapping.
    """
    file = folder / "deploy.yml"
    try:
        content = yaml.safe_load(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        fix = "Write the folder with `ugr bridge xpolicylab`."
        raise ConfigError(file, "a YAML file", " ".join(str(error).split())[:160], fix) from error
    if not isinstance(content, dict):
        raise ConfigError(file, "a mapping", type(content).__name__, "Write it with `ugr bridge xpolicylab`.")
    return content | {name: value for name, value in overrides.items() if value is not None}

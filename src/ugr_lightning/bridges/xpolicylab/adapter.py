"""The adapter folder that XPolicyLab's scripts expect (FACTS 7.2)."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from ugr_lightning.bridges.folder import place_checkpoint, require_module_name
from ugr_lightning.bridges.xpolicylab.model import Model
from ugr_lightning.errors import ConfigError


def write_adapter(
    checkpoint: Path,
    out: Path,
    *,
    execution: str | int = "aggregate",
    cameras: Mapping[str, str] | None = None,
    copy: bool = False,
) -> list[Path]:
    """Write an adapter folder for XPolicyLab, after loading the checkpoint as it will be loaded there.

    Args:
        checkpoint: file from `ugr fit`.
        out: the folder, `policy/<NAME>` of an XPolicyLab checkout.
        execution: see `Deployment`.
        cameras: XPolicyLab's names of the policy's cameras, where they differ from the usual ones.
        copy: put the checkpoint into the folder; otherwise the folder points to where it is now.

    Returns:
        The files written.

    Raises:
        ConfigError: the folder holds something else, or its name cannot be imported.
        CheckpointError: the checkpoint cannot be evaluated.
    """
    require_module_name(out)
    config = {"checkpoint": str(checkpoint.resolve()), "execution": execution, "cameras": dict(cameras or {})}
    model = Model(config)
    named = "".join(f"\n  {json.dumps(ours)}: {json.dumps(name)}" for ours, name in model.deployment.cameras.items())
    values = {"POLICY": out.name, "EXECUTION": str(execution), "CAMERAS": named}
    return place_checkpoint("xpolicylab", checkpoint, out, values, copy)


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

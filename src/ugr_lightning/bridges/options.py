"""Values of other projects' configs, whose command lines leave strings where numbers and switches are meant."""

import ast
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ugr_lightning.bridges.deployment import WHOLE_CHUNKS, Deployment
from ugr_lightning.data.layout import OTHER_NAMES, Layout
from ugr_lightning.errors import CheckpointError, ConfigError
from ugr_lightning.rollout.aggregation import AGGREGATE, AGGREGATE_VARIANCE

SWITCHES = {"true": True, "yes": True, "on": True, "1": True, "false": False, "no": False, "off": False, "0": False}
NOTHING = ("", "none", "null", "~")


def deployment_of(
    config: Mapping[str, Any],
    checkpoint: Path,
    *,
    cameras: Mapping[str, str],
    calibration: tuple[str, str],
    slots: int = 1,
) -> Deployment:
    """The policy that another project's config asks for.

    Args:
        config: `execution`, and optionally `temporal_agg` (false without a number of steps means whole chunks, as in
            ACT), `cameras`, `image_size`, `device`, `refine_ratio`, `ignore_layout`. What its command line could not
            evaluate arrives as strings, so "false" is false here and "25" a number.
        checkpoint: the policy's file.
        cameras: the environment's usual names of our cameras, which those of the config override.
        calibration: see `Deployment`.
        slots: how many environments at most.

    Raises:
        ConfigError: a value that cannot work.
        CheckpointError: not a usable checkpoint, or one whose training picked its joints from other ones.

    Source: RoboTwin-Platform/RoboTwin@13c3c47, script/eval_policy.py: `--key false` arrives as "false", which Python
        takes for true.
    """
    named = config.get("cameras") or {}
    if not isinstance(named, Mapping) or not all(isinstance(name, str) for name in named.values()):
        fix = "Write e.g. {cam_high: head_camera}."
        raise ConfigError("cameras", "the environment's name of each of the policy's cameras", named, fix)
    deployment = Deployment(
        checkpoint,
        cameras={**cameras, **named},
        calibration=calibration,
        execution=_execution(config),
        slots=slots,
        image_size=_shape(config, "image_size"),
        device=text(config, "device", "auto"),
        refine_ratio=number(config, "refine_ratio"),
    )
    layout = Layout.of_training(deployment.info.data)
    if layout.picked and not _switch(config, "ignore_layout"):
        fix = (
            "Where the environment has its joints in the policy's order and units, and only the files of the training "
            "had not, say so with `ignore_layout`."
        )
        got = f"those that `data.layout.{'` and `'.join(layout.picked)}` picked from the files of the training"
        raise CheckpointError(checkpoint, "joints as the environment has them", got, fix)
    for camera in set(deployment.cameras) & set(layout.cameras) - set(named):
        theirs, usual = layout.cameras[camera], deployment.cameras[camera]
        if theirs not in (camera, usual, *OTHER_NAMES.get(camera, ())):
            fix = f"Say it with `cameras`, e.g. {{{camera}: {theirs}}}."
            got = f"none; the usual one is {usual}, and the training's files had {theirs}"
            raise ConfigError("cameras", f"the environment's name of {camera}", got, fix)
    return deployment


def text(config: Mapping[str, Any], key: str, default: str | None = None) -> str:
    """A text.

    Raises:
        ConfigError: it is not set and has no default.
    """
    value = _value(config, key)
    if value is None and default is None:
        raise ConfigError(key, "a text", "nothing", f"Set `{key}` in the policy's yml.")
    return str(default if value is None else value)


def number(config: Mapping[str, Any], key: str) -> float | None:
    """A number; None where it is not set.

    Raises:
        ConfigError: something else.
    """
    value = _value(config, key)
    try:
        if isinstance(value, bool):
            raise ValueError(value)
        return None if value is None else float(value)
    except (TypeError, ValueError) as error:
        raise ConfigError(key, "a number", repr(value), "Correct the value.") from error


def _switch(config: Mapping[str, Any], key: str) -> bool | None:
    value = _value(config, key)
    if value is None or isinstance(value, bool):
        return value
    if str(value).strip().lower() in SWITCHES:
        return SWITCHES[str(value).strip().lower()]
    raise ConfigError(key, "true or false", repr(value), "Correct the value.")


def _shape(config: Mapping[str, Any], key: str) -> tuple[int, int] | None:
    """Height and width; None where they are not set."""
    value = _value(config, key)
    if isinstance(value, str):
        try:
            value = ast.literal_eval(value)
        except (ValueError, SyntaxError) as error:
            raise ConfigError(key, "height and width", repr(value), "Write e.g. [120, 160].") from error
    if value is None:
        return None
    if isinstance(value, (list, tuple)) and len(value) == 2 and all(type(n) is int and n > 0 for n in value):
        return value[0], value[1]
    raise ConfigError(key, "height and width", repr(value), "Write e.g. [120, 160].")


def _execution(config: Mapping[str, Any]) -> str | int:
    """How chunks are executed, also where it is said in the words of ACT's evaluators."""
    given, temporal_agg = _value(config, "execution"), _switch(config, "temporal_agg")
    chosen = AGGREGATE if given is None else str(given).strip()
    averages = chosen in (AGGREGATE, AGGREGATE_VARIANCE)
    if temporal_agg is False and averages:
        return WHOLE_CHUNKS
    if temporal_agg and not averages:
        fix = "Leave out `temporal_agg`, or set `execution` to `aggregate`."
        raise ConfigError("temporal_agg", f"false, as `execution` is {chosen}", "true", fix)
    return int(chosen) if chosen.isdigit() else chosen


def _value(config: Mapping[str, Any], key: str) -> Any:
    value = config.get(key)
    return None if isinstance(value, str) and value.strip().lower() in NOTHING else value

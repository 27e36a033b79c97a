"""`ugr import-act` and `ugr import-lerobot`: policies that other projects have trained."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ugr_lightning.cli.parsing.call import call
from ugr_lightning.embodiment import CAMERAS
from ugr_lightning.errors import ConfigError
from ugr_lightning.models.precision import Precision

if TYPE_CHECKING:
    from ugr_lightning.contract import ChunkPolicy


def _import_act(
    checkpoint: str,
    out: str,
    statistics: str | None = None,
    cameras: list[str] = list(CAMERAS),  # noqa: B006 - jsonargparse copies it
    heads: int = 8,
    precision: Precision = "fp32",
    task: str | None = None,
    image_size: tuple[int, int] = (480, 640),
) -> int:
    """Make a checkpoint of ours from one of the original ACT code, or of RoboTwin's copy of it.

    Args:
        checkpoint: `policy_best.ckpt` or another one of that code.
        out: file for the result; it must not exist.
        statistics: its `dataset_stats.pkl`; null means the one beside the checkpoint.
        cameras: names of the cameras that the policy saw; the checkpoint does not say them.
        heads: attention heads; the checkpoint does not say them.
        precision: arithmetic of the trunk; `fp32` is the original's, `auto` is faster and a little different.
        task: what the policy was trained on, for `ugr test`.
        image_size: height and width of the images that it was trained on.
    """
    from ugr_lightning.bridges.act_checkpoint import EXTRA, import_act
    from ugr_lightning.bridges.act_statistics import read_act_statistics
    from ugr_lightning.models.checkpoint import read_checkpoint

    require_new(out)
    numbers = read_act_statistics(statistics or Path(checkpoint).with_name("dataset_stats.pkl"))
    content = read_checkpoint(checkpoint)
    policy, extra = import_act(content, numbers, cameras=cameras, heads=heads, precision=precision, where=checkpoint)
    _save(out, policy, {"task": task, "image_size": image_size, "state": "commanded"}, {EXTRA: extra})
    print(
        f"imported    {len(content) - len(extra['unused'])} of {len(content)} tensors; unused, and kept for an export:"
    )
    print("\n".join(f"  {line}" for line in _grouped(extra["unused"])))
    print(f"assumed     {heads} heads; cameras {', '.join(cameras)}: the checkpoint says neither")
    return 0


def _import_lerobot(
    folder: str,
    out: str,
    cameras: list[str] | None = None,
    precision: Precision = "fp32",
    task: str | None = None,
    image_size: tuple[int, int] | None = None,
) -> int:
    """Make a checkpoint of ours from a folder of lerobot's with an ACT policy.

    Args:
        folder: `pretrained_model`, with `config.json` and `model.safetensors`.
        out: file for the result; it must not exist.
        cameras: new names for the cameras, in the order of `input_features`; null takes lerobot's.
        precision: arithmetic of the trunk; `fp32` is lerobot's, `auto` is faster and a little different.
        task: what the policy was trained on, for `ugr test`.
        image_size: height and width of the images; null takes what `config.json` says.
    """
    from ugr_lightning.bridges.lerobot_policy import import_lerobot

    require_new(out)
    policy, size, notes = import_lerobot(Path(folder), cameras=cameras, precision=precision)
    _save(out, policy, {"task": task, "image_size": image_size or size, "state": "commanded"}, {})
    print("\n".join(f"note        {note}" for note in notes))
    return 0


def require_new(out: str) -> None:
    """Refuse to overwrite a file."""
    if Path(out).exists():
        raise ConfigError("--out", "a file that does not exist yet", out, "Choose another name, or delete it.")


def _save(out: str, policy: "ChunkPolicy", data: dict[str, Any], extra: dict[str, Any]) -> None:
    from ugr_lightning.models.checkpoint import save_policy

    save_policy(out, policy, {name: value for name, value in data.items() if value is not None}, extra)
    count = sum(parameter.numel() for parameter in policy.parameters())
    print(f"{out}: {type(policy).__name__}, {count:,} parameters in use")


def _grouped(names: Sequence[str]) -> list[str]:
    """Names below a numbered layer as one line."""
    groups: dict[str, int] = {}
    for name in names:
        parts = name.split(".")
        number = next((index for index, part in enumerate(parts) if part.isdigit()), None)
        key = name if number is None else ".".join(parts[: number + 1]) + ".*"
        groups[key] = groups.get(key, 0) + 1
    return [name if count == 1 else f"{name} ({count} tensors)" for name, count in groups.items()]


FUNCTIONS: dict[str, tuple[Callable[..., int], tuple[str, ...]]] = {
    "import-act": (_import_act, ("checkpoint", "statistics")),
    "import-lerobot": (_import_lerobot, ("folder",)),
}


def run(command: str, argv: Sequence[str]) -> int:
    """Run one of the subcommands above."""
    function, leading = FUNCTIONS[command]
    return call(function, command, argv, leading)

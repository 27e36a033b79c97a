"""`--data own`: the demonstrations that a checkpoint was trained on, found again."""

from typing import TYPE_CHECKING

from ugr_lightning.cli.parsing.config import flat
from ugr_lightning.errors import ConfigError

if TYPE_CHECKING:
    from ugr_lightning.contract import ChunkPolicy
    from ugr_lightning.data.chunks import AfterEnd
    from ugr_lightning.data.datamodule import ChunkDataModule
    from ugr_lightning.models.checkpoint import PolicyInfo

OWN = "own"


def open_own(
    policy: "ChunkPolicy", info: "PolicyInfo", data: str = OWN, after_end: "AfterEnd | None" = None
) -> "ChunkDataModule":
    """Open the demonstrations a checkpoint was trained on, and say where they are.

    Args:
        policy: from the checkpoint.
        info: what the checkpoint says about itself.
        data: `own` is the folder that `config.yaml` beside the checkpoint names, the usual one where there is no such
            file; otherwise see `open_data`.
        after_end: see `open_data`.

    Raises:
        CheckpointError: a policy that was imported.
        ConfigError: they were in a folder of their own, and nothing says which.
        DataError: they are not there, or others are; or `config.yaml` is damaged.
    """
    from ugr_lightning.data.datamodule import DEFAULT_ROOT
    from ugr_lightning.results.evaluations import run_config
    from ugr_lightning.uncertainty.predictions import open_data

    trained, named_by = info.trained_on, ""
    if data == OWN:
        config = (info.path if info.path.is_dir() else info.path.parent) / "config.yaml"
        named = flat(run_config(config))
        usual = None if trained.get("elsewhere") else DEFAULT_ROOT
        place = named.get("data.folder") or named.get("data.root") or usual
        if place is None:
            got = f"no {config} that names it"
            raise ConfigError("--data", "the folder that the policy was trained on", got, "Give it: `--data FOLDER`.")
        data, named_by = str(place), f"{config}" if place is not usual else "the default of `data.root`"
    opened = open_data(policy, trained, data, after_end, named_by)
    print(f"data: {opened.folder}")
    return opened

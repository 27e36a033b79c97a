"""How Lightning writes and reads checkpoints here."""

from typing import Any

from lightning.pytorch.plugins.io import TorchCheckpointIO

from ugr_lightning.models.checkpoint import read_checkpoint, write_checkpoint


class AtomicCheckpointIO(TorchCheckpointIO):
    """Checkpoints that are whole or absent, read without running any code."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        write_checkpoint(path, checkpoint)

    def load_checkpoint(self, path: Any, map_location: Any = None, weights_only: bool | None = None) -> dict[str, Any]:
        """Read one checkpoint, with `weights_only=True` whatever was asked."""
        return read_checkpoint(path)

"""`ugr export`: a checkpoint for other programs."""

from functools import partial
from pathlib import Path
from typing import Literal

from ugr_lightning.cli.parsing.call import call


def _export(
    checkpoint: str,
    to: Literal["act", "lerobot", "safetensors", "onnx", "torch"],
    out: str,
    run: str | None = None,
    root: str = "runs",
    drop_refinement: bool = False,
    image_size: tuple[int, int] | None = None,
    licence: str = "apache-2.0",
) -> int:
    """Write a checkpoint for another program, read it back and compare the actions.

    Args:
        checkpoint: `best`, `best_loss`, `last`, a checkpoint file, or an exported folder of safetensors.
        to: `act` for the original ACT code; `lerobot`; `safetensors` with `config.json` and a model card; `onnx` or
            `torch` for the graph from images and state to actions.
        out: folder for the result; it must not exist, or be empty.
        run: name or folder of a run; null takes the newest run.
        root: folder of all runs.
        drop_refinement: export the coarse actions alone where the target has no place for a refinement.
        image_size: height and width of the images; null takes the checkpoint's.
        licence: of the weights, for the model card.
    """
    from ugr_lightning.bridges.export import export_policy
    from ugr_lightning.training.runs import resolve_checkpoint

    file = resolve_checkpoint(checkpoint, run, root)
    made = export_policy(file, to, Path(out), drop_refinement=drop_refinement, image_size=image_size, licence=licence)
    print(f"checkpoint: {file}")
    print("\n".join(f"  {Path(out) / name}" for name in made.files))
    print("\n".join(f"note: {note}" for note in made.notes) or "note: nothing was left behind")
    print(f"read back: actions differ by at most {made.difference:.3g} in robot units")
    return 0


run = partial(call, _export, leading=["checkpoint"])

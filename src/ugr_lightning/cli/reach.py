"""`ugr reach`: a refinement towards what is seen, for a policy that was trained without one."""

from functools import partial
from pathlib import Path

from ugr_lightning.cli.parsing.call import Count, call
from ugr_lightning.errors import CheckpointError


def _reach(
    checkpoint: str = "best",
    run: str | None = None,
    root: str = "runs",
    data: str = "data/160x120",
    stride: Count = 12,
    out: str | None = None,
) -> int:
    """Refine a trained policy with keyframes towards where it sees that each hand will grip next (ViperX arms).

    Takes the place of the refinement it has, if any. Everything else stays as it was trained; `ugr fit --config
    keyframes/reach` trains both together.

    Args:
        checkpoint: `best`, `best_loss`, `last`, or a checkpoint file.
        run: name or folder of a run; null takes the newest run.
        root: folder of all runs.
        data: folder of the recordings that the policy was trained on, `data.root`, or `data.folder` if it had one.
        stride: control steps between two of the chunks that it learns from.
        out: checkpoint to write; null means `<checkpoint>_reach.ckpt` beside the checkpoint.
    """
    import torch

    from ugr_lightning.models.act import ACT
    from ugr_lightning.models.checkpoint import load_policy, save_policy
    from ugr_lightning.sim.kinematics import forward
    from ugr_lightning.training.keyframe_error import event_errors
    from ugr_lightning.training.runs import resolve_checkpoint
    from ugr_lightning.uncertainty.predictions import batches, open_data
    from ugr_lightning.uncertainty.reaching import fit_reach, with_reach

    file = resolve_checkpoint(checkpoint, run, root)
    policy, info = load_policy(file)
    if not isinstance(policy, ACT):
        raise CheckpointError(file, "a policy of the class ACT", type(policy).__name__, "Choose another checkpoint.")
    opened = open_data(policy, info.trained_on, data)
    torch.manual_seed(0)
    reaching = with_reach(policy)
    fit_reach(reaching, opened, stride=stride)
    before, after = [], []
    for batch in batches(opened, opened.episode_split.validation, stride=stride):
        chunk = reaching.predict(batch.observation)
        assert chunk.coarse is not None
        before.append(event_errors(forward, chunk.coarse, batch))
        after.append(event_errors(forward, chunk.actions, batch))
    path = Path(out) if out else file.with_name(f"{file.stem}_reach.ckpt")
    save_policy(path, reaching, dict(info.data))
    if len(torch.cat(before)):
        off = " and ".join(f"{torch.cat(errors).median():.1f}" for errors in (before, after))
        print(f"tools at keyframes of validation episodes, before and after: {off} mm off (medians)")
    print(f"written: {path}")
    return 0


run = partial(call, _reach, leading=["checkpoint"])

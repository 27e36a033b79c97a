"""`ugr refine`: a refinement for a policy that is trained."""

from functools import partial
from pathlib import Path

from ugr_lightning.cli.import_checkpoint import require_new
from ugr_lightning.cli.parsing.call import Count, call
from ugr_lightning.cli.parsing.data import OWN, open_own
from ugr_lightning.errors import CheckpointError
from ugr_lightning.models.refine.selector import Selector


def _refine(
    checkpoint: str = "best",
    run: str | None = None,
    root: str = "runs",
    refine: Selector | None = None,
    data: str = OWN,
    stride: Count = 12,
    out: str | None = None,
) -> int:
    """Refine a trained ACT: fit a refinement to the chunks that it predicts, in minutes.

    Takes the place of the refinement it has, if any. Everything else stays as it was trained.

    Args:
        checkpoint: `best`, `best_loss`, `last`, or a checkpoint file.
        run: name or folder of a run; null takes the newest run.
        root: folder of all runs.
        refine: which steps are refined: Full, Block, Uncertainty, or a selector of your own; null means every step.
        data: folder of the recordings that the policy was trained on, `data.root`, or `data.folder` if it had one;
            `own` is what `config.yaml` beside the checkpoint names.
        stride: control steps between two of the chunks that it learns from.
        out: checkpoint to write, which must not exist; null means `<checkpoint>_refined.ckpt` beside the checkpoint,
            in place of an earlier one.
    """
    import torch

    from ugr_lightning.models.act import ACT
    from ugr_lightning.models.checkpoint import load_policy, save_policy
    from ugr_lightning.models.refine.full import Full
    from ugr_lightning.training.keyframe_error import event_errors, known_kinematics
    from ugr_lightning.training.runs import resolve_checkpoint
    from ugr_lightning.uncertainty.predictions import batches
    from ugr_lightning.uncertainty.refitting import fit_refinement, with_refinement

    if out:
        require_new(out)
    file = resolve_checkpoint(checkpoint, run, root)
    policy, info = load_policy(file)
    if not isinstance(policy, ACT):
        raise CheckpointError(file, "a policy of the class ACT", type(policy).__name__, "Choose another checkpoint.")
    torch.manual_seed(0)
    refining = with_refinement(policy, refine or Full())
    opened = open_own(policy, info, data)
    fit_refinement(refining, opened, stride=stride)
    path = Path(out) if out else file.with_name(f"{file.stem}_refined.ckpt")
    save_policy(path, refining, dict(info.data), {"global_step": info.step, "epoch": info.epoch})
    forward, std = known_kinematics(opened), opened.statistics.action_std
    error: tuple[list[torch.Tensor], ...] = ([], [])  # before and after
    tools: tuple[list[torch.Tensor], ...] = ([], [])
    for batch in batches(opened, opened.episode_split.validation, stride=stride):
        for side, one in enumerate((policy, refining)):
            actions = one.predict(batch.observation).actions
            error[side].append(((actions - batch.actions).abs() / std)[batch.valid])
            if forward is not None and batch.keyframes is not None:
                tools[side].append(event_errors(forward, actions, batch))
    before, after = (float(torch.cat(one).mean()) for one in error)
    print(f"action error on validation episodes, before and after: {before:.4f} and {after:.4f}")
    if tools[0]:
        before, after = (float(torch.cat(one).median()) for one in tools)
        print(f"tools at keyframes, before and after: {before:.1f} and {after:.1f} mm off (medians)")
    print(f"written: {path}")
    return 0


run = partial(call, _refine, leading=["checkpoint"])

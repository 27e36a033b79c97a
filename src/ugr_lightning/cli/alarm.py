"""`ugr alarm`: what rollouts and bridges raise an alarm for."""

from functools import partial

from ugr_lightning.cli.parsing.call import call
from ugr_lightning.errors import CheckpointError, DataError
from ugr_lightning.training.runs import resolve_checkpoint


def _alarm(checkpoint: str, results: str, rate: float = 0.1, run: str | None = None, root: str = "runs") -> int:
    """Set the alarm that rollouts and bridges raise where what happens is rare before a success.

    Args:
        checkpoint: `best`, `best_loss`, `last`, a checkpoint file, or a folder from `ugr export --to safetensors`.
        results: what `ugr rollout CHECKPOINT --seeds selection --out FILE` wrote, with the execution that the alarm is
            for; each execution in it gets an alarm of its own.
        rate: share of successful episodes, at most, that it may be raised in.
        run: name or folder of a run; null takes the newest run.
        root: folder of all runs.
    """
    from ugr_lightning.models.checkpoint import load_policy
    from ugr_lightning.results.results import read_results
    from ugr_lightning.rollout.alarm import read_alarms, set_alarm, write_alarms

    file = resolve_checkpoint(checkpoint, run, root)
    sha256 = load_policy(file)[1].sha256
    own = [item for item in read_results(results) if (item.checkpoint, item.refine_ratio) == (sha256, None)]
    if not own:
        fix = "Roll it out as it was trained: `ugr rollout CHECKPOINT --seeds selection --out FILE`."
        raise DataError(results, f"episodes of {file} (sha256 {sha256[:12]})", "none", fix)
    executions = sorted({item.execution for item in own})
    alarms = [set_alarm([item for item in own if item.execution == execution], rate) for execution in executions]
    try:
        kept = {name: alarm for name, alarm in read_alarms(file, sha256).items() if name not in executions}
    except CheckpointError as error:  # of another checkpoint that was there, or damaged
        print(f"replaced: {error}")
        kept = {}
    path = write_alarms(file, [*kept.values(), *alarms])
    for alarm in alarms:
        bad = [item for item in own if item.execution == alarm.execution and not item.success]
        disagree = sum((item.disagreement or 0.0) > alarm.threshold for item in bad)
        print(f"alarm, {alarm}. Chunks disagree as much in {disagree} of the {len(bad)} failures among these episodes.")
    print(f"written: {path}")
    return 0


run = partial(call, _alarm, leading=["checkpoint", "results"])

"""`ugr analyze`: whether a checkpoint's uncertainty knows the error."""

from functools import partial
from pathlib import Path
from typing import Literal

from ugr_lightning.cli.parsing.call import Count, call
from ugr_lightning.cli.parsing.data import OWN, open_own
from ugr_lightning.errors import ConfigError


def _analyze(
    checkpoint: str = "best",
    run: str | None = None,
    root: str = "runs",
    data: str = OWN,
    stride: Count = 5,
    after_end: Literal["mask", "hold"] | None = None,
    resamples: Count = 500,
    budgets: bool = False,
    estimators: bool = False,
    residuals: bool = False,
    traces: str | None = None,
    out: str | None = None,
) -> int:
    """Say whether a policy's uncertainty knows the error, on the validation episodes of its own split.

    Policies without a predicted uncertainty are asked for what they have: `residuals` and `traces`.

    Args:
        checkpoint: `best`, `best_loss`, `last`, or a checkpoint file.
        run: name or folder of a run; null takes the newest run.
        root: folder of all runs.
        data: folder of the recordings that the policy was trained on, `data.root`, or `data.folder` if it had one;
            `own` is what `config.yaml` beside the checkpoint names.
        stride: control steps between two queries.
        after_end: count steps past the end of an episode (`hold`) or not (`mask`); null does as the training did.
        resamples: draws of the bootstrap over episodes.
        budgets: also the error when from none to all of the steps are refined, chosen by s_k and by its rivals.
        estimators: also another estimate of the uncertainty: overlapping chunks.
        residuals: also how much of the error on new scenes can be foretold from what a refinement branch sees.
        traces: folder that `ugr rollout --traces` filled; says whether s_k, or chunks that disagree, warned
            before episodes failed.
        out: folder for tables, numbers and figures; null means `analysis-<checkpoint>` beside the checkpoint.
    """
    from ugr_lightning.models.act import ACT
    from ugr_lightning.models.checkpoint import load_policy
    from ugr_lightning.models.refine.budget import with_refine_ratio
    from ugr_lightning.training.runs import resolve_checkpoint
    from ugr_lightning.uncertainty import study as kit

    file = resolve_checkpoint(checkpoint, run, root)
    policy, info = load_policy(file)
    if budgets:
        with_refine_ratio(policy, 1.0)  # an error where the policy ranks no steps
    if residuals and not isinstance(policy, ACT):
        raise ConfigError("--residuals", "a policy of the class ACT", type(policy).__name__, "Leave it out.")
    opened = open_own(policy, info, data, after_end)
    described = {"file": str(file), "sha256": info.sha256, "task": opened.task}
    study = kit.begin_study(policy, opened, described, stride=stride, resamples=resamples)
    if budgets:
        kit.add_budgets(study)
    if estimators:
        kit.add_estimators(study)
    if residuals:
        kit.add_foretold(study)
    if traces is not None:
        kit.add_failures(study, Path(traces))
    print(f"checkpoint: {file}\n{study}")
    folder = Path(out) if out else file.with_name(f"analysis-{file.stem}")
    study.write(folder)
    print(f"numbers, tables and figures: {folder}")
    return 0


run = partial(call, _analyze, leading=["checkpoint"])

"""`ugr demo`: record, train, evaluate, and one table at the end."""

import time
from dataclasses import replace
from functools import partial
from pathlib import Path

from ugr_lightning.cli.parsing.call import call


def _demo(
    config: list[str] = ["demo"],  # noqa: B006 - jsonargparse copies it
    episodes: int = 100,
    workers: int = 2,
    root: str = "runs",
    run: str = "demo",
) -> int:
    """Record demonstrations, train a policy, and evaluate it beside the expert and a policy that does nothing.

    Args:
        config: configs of the training, as for `ugr fit`.
        episodes: evaluation seeds per row of the table.
        workers: simulator processes.
        root: folder of all runs.
        run: name of the run.
    """
    from ugr_lightning.cli import fit
    from ugr_lightning.cli.rollout import both_executions
    from ugr_lightning.models.checkpoint import load_policy
    from ugr_lightning.results.results import success_table
    from ugr_lightning.rollout.evaluate import checkpoint_actor, evaluation_spec, run_episodes
    from ugr_lightning.rollout.simulators import Simulators
    from ugr_lightning.training.runs import resolve_checkpoint, versions_of

    began = time.monotonic()
    options = [option for path in config for option in ("--config", path)]
    fit.run("fit", [*options, "--run", run, "--trainer.default_root_dir", root])
    checkpoint = resolve_checkpoint("best", str(versions_of(Path(root) / run)[-1]), Path(root))
    folder, (policy, info) = checkpoint.parent, load_policy(checkpoint)
    spec = evaluation_spec(info.data, None, "evaluation", episodes, workers=workers, out=folder / "evaluation.jsonl")
    few = evaluation_spec(info.data, None, "evaluation", min(episodes, 10), workers=workers, out=spec.out)
    film = {spec.seeds[0]: folder / "episode.gif"}
    actor = checkpoint_actor(policy, info, spec.task)
    results = []
    with Simulators() as simulators:
        for dummy in ("zero", "expert"):
            results += run_episodes(dummy, few, simulators=simulators)
        chunks = both_executions(policy)[1]  # aggregation asks in every step, which takes ten times as long
        results += run_episodes(actor, replace(spec, execution=chunks, videos=film), simulators=simulators)
    print(f"\n{success_table(results)}\n")
    print(f"{(time.monotonic() - began) / 60:.1f} minutes; checkpoint {checkpoint}, episode {folder / 'episode.gif'}")
    print(f"With the chunks of all steps aggregated, as in the paper:  ugr test --root {root} --run {run}")
    print(f"Watch the training:  tensorboard --logdir {root}")
    return 0


run = partial(call, _demo)

"""`ugr bridge`: let a checkpoint be evaluated by other projects."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from ugr_lightning.cli.parsing.call import call_one_of
from ugr_lightning.cli.rollout import ExecutionName
from ugr_lightning.errors import ConfigError
from ugr_lightning.system.signals import Stopped
from ugr_lightning.training.runs import or_best, resolve_checkpoint


def _robotwin(
    checkpoint: str = "best",
    run: str | None = None,
    root: str = "runs",
    out: str = "policy/UGR",
    execution: ExecutionName = "aggregate",
    cameras: dict[str, str] | None = None,
    ignore_layout: bool = False,
    copy: bool = False,
) -> int:
    """Write a policy folder for RoboTwin 2.0's branch `stable_2.0`; its `main` evaluates through `ugr bridge serve`.

    Args:
        checkpoint: `best`, `best_loss`, `last`, a checkpoint file, or a folder from `ugr export --to safetensors`.
        run: name or folder of a run; null takes the newest run.
        root: folder of all runs.
        out: the folder; its name is the policy's. `policy/NAME` of a checkout of the branch `stable_2.0`.
        execution: `aggregate`; `aggregate-variance`; or the number of steps executed of each chunk.
        cameras: RoboTwin's names of the policy's cameras, where they are not the usual ones.
        ignore_layout: its joints are in the policy's order and units, though `data.layout` of the training picked them
            from files that had not.
        copy: put the checkpoint into the folder; otherwise the folder points to where it is.
    """
    from ugr_lightning.bridges.robotwin_policy import write_policy

    given: dict[str, Any] = {"execution": execution, "cameras": cameras, "ignore_layout": ignore_layout, "copy": copy}
    written = write_policy(resolve_checkpoint(checkpoint, run, root), Path(out), **given)
    print("\n".join(f"  {path}" for path in written))
    print("For RoboTwin's branch stable_2.0; its main has no policy folder and evaluates through `ugr bridge serve`.")
    print(f"In RoboTwin: bash policy/{Path(out).name}/eval.sh TASK demo_clean {Path(out).name} 0 0")
    return 0


def _xpolicylab(
    checkpoint: str = "best",
    run: str | None = None,
    root: str = "runs",
    out: str = "policy/UGR",
    execution: ExecutionName = "aggregate",
    cameras: dict[str, str] | None = None,
    ignore_layout: bool = False,
    copy: bool = False,
) -> int:
    """Write an adapter folder for XPolicyLab's evaluation.

    Args:
        checkpoint: `best`, `best_loss`, `last`, a checkpoint file, or a folder from `ugr export --to safetensors`.
        run: name or folder of a run; null takes the newest run.
        root: folder of all runs.
        out: the folder; its name is the policy's. `policy/NAME` of an XPolicyLab checkout.
        execution: `aggregate`; `aggregate-variance`; or the number of steps executed of each chunk.
        cameras: XPolicyLab's names of the policy's cameras, where they are not the usual ones.
        ignore_layout: its joints are in the policy's order and units, though `data.layout` of the training picked them
            from files that had not.
        copy: put the checkpoint into the folder; otherwise the folder points to where it is.
    """
    from ugr_lightning.bridges.xpolicylab.adapter import write_adapter

    given: dict[str, Any] = {"execution": execution, "cameras": cameras, "ignore_layout": ignore_layout, "copy": copy}
    written = write_adapter(resolve_checkpoint(checkpoint, run, root), Path(out), **given)
    print("\n".join(f"  {path}" for path in written))
    print(f"In XPolicyLab: bash policy/{Path(out).name}/eval.sh; its README has the arguments.")
    return 0


def _serve(
    checkpoint: str | None = None,
    run: str | None = None,
    root: str = "runs",
    folder: str | None = None,
    host: str = "127.0.0.1",
    port: int = 19000,
    execution: ExecutionName | None = None,
    bench_name: str | None = None,
    task_name: str | None = None,
    ckpt_name: str | None = None,
    env_cfg_type: str | None = None,
    action_type: str | None = None,
    seed: str | None = None,
) -> int:
    """Answer XPolicyLab's environment clients over a websocket, until interrupted.

    Args:
        checkpoint: `best`, `best_loss`, `last`, or a checkpoint file; null takes `best` of a `run` that is given, or
            the adapter folder's.
        run: name or folder of a run; null takes the newest run.
        root: folder of all runs.
        folder: adapter folder written by `ugr bridge xpolicylab`; null serves the checkpoint with the usual settings.
        host: where to listen; the default is reachable from this machine only.
        port: where to listen; 0 takes a free one.
        execution: `aggregate`; `aggregate-variance`; or the number of steps executed of each chunk.
        bench_name: XPolicyLab's name of the benchmark.
        task_name: XPolicyLab's name of the task.
        ckpt_name: which run, where the folder names no checkpoint.
        env_cfg_type: XPolicyLab's name of the robot.
        action_type: `joint`.
        seed: of the training.
    """
    import asyncio

    from ugr_lightning.bridges.xpolicylab.adapter import read_deployment
    from ugr_lightning.bridges.xpolicylab.model import XPolicyModel
    from ugr_lightning.bridges.xpolicylab.server import PolicyServer

    names = {"bench_name": bench_name, "task_name": task_name, "ckpt_name": ckpt_name, "env_cfg_type": env_cfg_type}
    given = {**names, "action_type": action_type, "seed": seed, "execution": execution}
    checkpoint = or_best(checkpoint, run)
    given["checkpoint"] = None if checkpoint is None else str(resolve_checkpoint(checkpoint, run, root).resolve())
    if folder is None and checkpoint is None:
        fix = "Give --checkpoint FILE, or --folder of `ugr bridge xpolicylab`."
        raise ConfigError("ugr bridge serve", "a checkpoint", "none", fix)
    config = given if folder is None else read_deployment(Path(folder), given)
    model = XPolicyModel(config, None if folder is None else Path(folder).resolve())
    print(f"policy: {model.deployment}", flush=True)
    server = PolicyServer(model, host, port)
    raise Stopped(asyncio.run(server.serve(lambda url: print(f"listening on {url}", flush=True))))


FUNCTIONS: dict[str, tuple[Callable[..., int], tuple[str, ...]]] = {
    "robotwin": (_robotwin, ("checkpoint",)),
    "xpolicylab": (_xpolicylab, ("checkpoint",)),
    "serve": (_serve, ("checkpoint",)),
}
run = partial(call_one_of, FUNCTIONS)

"""`ugr bridge`: let a checkpoint be evaluated by other projects."""

from collections.abc import Callable, Sequence
from pathlib import Path

from ugr_lightning.cli.call import call
from ugr_lightning.cli.rollout import ExecutionName
from ugr_lightning.errors import ConfigError


def _robotwin(
    ckpt: str,
    out: str = "policy/UGR",
    execution: ExecutionName = "aggregate",
    cameras: dict[str, str] | None = None,
    copy: bool = False,
) -> int:
    """Write a policy folder for RoboTwin 2.0's evaluation.

    Args:
        ckpt: checkpoint file from `ugr fit`.
        out: the folder; its name is the policy's. `policy/NAME` of a RoboTwin checkout.
        execution: `aggregate`; `aggregate-variance`; or the number of steps executed of each chunk.
        cameras: RoboTwin's names of the policy's cameras, where they are not the usual ones.
        copy: put the checkpoint into the folder; otherwise the folder points to where it is.
    """
    from ugr_lightning.bridges.robotwin import write_policy

    written = write_policy(Path(ckpt), Path(out), execution=execution, cameras=cameras, copy=copy)
    print("\n".join(f"  {path}" for path in written))
    print(f"In RoboTwin: bash policy/{Path(out).name}/eval.sh TASK demo_clean {Path(out).name} 0 0")
    return 0


FUNCTIONS: dict[str, Callable[..., int]] = {"robotwin": _robotwin}


def run(command: str, argv: Sequence[str]) -> int:
    """Run `ugr bridge NAME`."""
    if not argv or argv[0] not in FUNCTIONS:
        names = "\n".join(
            f"  ugr bridge {name:<12}{(part.__doc__ or '').splitlines()[0]}" for name, part in FUNCTIONS.items()
        )
        if argv and argv[0] in ("-h", "--help"):
            print(f"Let a checkpoint be evaluated by other projects.\n{names}")
            return 0
        got = argv[0] if argv else "nothing"
        raise ConfigError("ugr bridge", f"one of {', '.join(FUNCTIONS)}", got, "`ugr bridge --help` lists them.")
    return call(FUNCTIONS[argv[0]], f"{command} {argv[0]}", argv[1:])

"""`ugr`: the one place that knows the command line; a subcommand is imported when it is asked for."""

import gc
import importlib
import os
import sys
from collections.abc import Sequence
from types import ModuleType

from ugr_lightning.cli.failures import explain_disk
from ugr_lightning.errors import UGRError
from ugr_lightning.system.signals import Stopped, stoppable

COMMANDS: dict[str, tuple[str, str]] = {
    "demo": ("demo", "the whole loop in minutes: record, train, evaluate, show a table"),
    "doctor": ("doctor", "check this machine and say what to do"),
    "tasks": ("tasks", "list the simulated tasks; verify them"),
    "collect": ("collect", "record demonstrations of a task's scripted expert"),
    "fit": ("fit", "train a policy; records missing demonstrations first"),
    "validate": ("fit", "validation losses and errors of a checkpoint"),
    "test": ("rollout", "success of a checkpoint on the evaluation seeds, both execution modes"),
    "rollout": ("rollout", "let a checkpoint, or zero, random or expert, act in a task"),
    "predict": ("predict", "a checkpoint's commands beside those of demonstrations, by joint"),
    "analyze": ("analyze", "whether a checkpoint's uncertainty knows the error"),
    "alarm": ("alarm", "set the alarm that rollouts and bridges raise before a checkpoint fails"),
    "refine": ("refine", "fit a refinement to a policy that is trained"),
    "sweep": ("sweep", "one checkpoint with many budgets and executions, in closed loop"),
    "benchmark": ("benchmark.command", "policies, tasks and training seeds of one yaml: record, train, evaluate"),
    "shards": ("shards", "collect, rollout, test or sweep in parts on a cluster, put together here"),
    "report": ("report", "compare policies: intervals, paired tests, what may be concluded"),
    "replay": ("replay", "execute recorded commands again and confirm the outcome"),
    "inspect": ("inspect", "say what a checkpoint, an episode or a folder is"),
    "view": ("view", "a demonstration, predictions or a rollout as a timeline, in rerun"),
    "data": ("data", "say what demonstrations of any format are; convert them"),
    "bridge": ("bridge", "let RoboTwin or XPolicyLab evaluate a checkpoint"),
    "import-act": ("import_checkpoint", "make a checkpoint of one of the original ACT code's"),
    "import-lerobot": ("import_checkpoint", "make a checkpoint of one of lerobot's ACT policies"),
    "export": ("export", "write a checkpoint for other programs: act, safetensors, onnx, ..."),
    "speed": ("speed", "measure speed on this machine"),
}

RENAMED = {"bench": "speed"}
"""Commands that had another name in earlier versions."""

FIRST_RUN = """ugr-lightning: train and understand action-chunking robot policies.

First run:
  ugr doctor                                  is everything there?
  ugr fit --config uncert                     record demonstrations, train, roll out
  ugr test --run uncert                       success on the evaluation seeds
  tensorboard --logdir runs                   watch it

Commands (`ugr COMMAND --help`):
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one subcommand.

    Args:
        argv: arguments without the program's name; `sys.argv` by default.

    Returns:
        Exit code: 0 fine, 2 a problem the user can solve, 128 + N ended by signal N (130 Ctrl-C, 143 SIGTERM).
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(FIRST_RUN + "\n".join(f"  {name:<16}{about}" for name, (_, about) in COMMANDS.items()))
        return 0
    if os.getcwd() not in sys.path:  # last: a user's package is found here, and hides nothing
        sys.path.append(os.getcwd())
    try:
        with stoppable():
            return _run(arguments[0], arguments[1:])
    except (UGRError, OSError, RuntimeError) as error:
        if isinstance(error, BrokenPipeError):  # `ugr ... | head`
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 0
        told = error if isinstance(error, UGRError) else explain_disk(error)
        if told is None or os.environ.get("UGR_DEBUG") == "1":
            raise
        print(f"ugr {arguments[0]}: {type(told).__name__}\n{told}", file=sys.stderr)
        return 2
    except Stopped as stop:
        print(f"ugr {arguments[0]}: interrupted by {stop}", file=sys.stderr)
        return stop.exit_code
    except KeyboardInterrupt:
        print(f"ugr {arguments[0]}: interrupted", file=sys.stderr)
        return 130


def _run(command: str, arguments: list[str]) -> int:
    if command == "--version":
        from importlib.metadata import version

        print(version("ugr-lightning"))
        return 0
    if command not in COMMANDS:
        import difflib

        from ugr_lightning.errors import ConfigError

        near = RENAMED.get(command) or next(iter(difflib.get_close_matches(command, COMMANDS, n=1)), None)
        fix = f"Did you mean `ugr {near}`?" if near else "`ugr` alone lists the commands."
        raise ConfigError("ugr", "a command", command, fix)
    return int(_loaded(f"ugr_lightning.cli.{COMMANDS[command][0]}").run(command, arguments))


def _loaded(module: str) -> ModuleType:
    """A command with all that it imports: a million objects, none of them garbage, which are not searched for any."""
    if module not in sys.modules:
        gc.disable()
        try:
            importlib.import_module(module)
        finally:
            gc.enable()
            gc.freeze()
    return sys.modules[module]


if __name__ == "__main__":
    sys.exit(main())

"""Promises that tests hold already: they are run, and counted."""

import functools
import re
import subprocess
import sys
from pathlib import Path

from trial import Piece

ROOT = Path(__file__).resolve().parents[2]

# name: what is done, what has to come out, and the tests that say so.
SUITES = {
    "signals": (
        "SIGINT, SIGTERM, SIGHUP in a step, a validation and the loading of data",
        "their exit codes, and a checkpoint that goes on bit for bit",
        ["tests/cli/test_fit.py", "-k", "signal or interrupt"],
    ),
    "simulators": (
        "a simulator that is killed, hangs, raises, or has no memory left; a process killed between two messages",
        "its own episode counts as crashed, the others go as they do alone; recording skips the seed",
        ["tests/rollout/test_evaluate.py", "tests/demos/test_collect.py", "-k", "crash or dies or kill or hang"],
    ),
    "numbers": (
        "NaN in demonstrations, losses, predictions and what a client sends",
        "a sentence that names it; it reaches no simulator and no checkpoint",
        ["tests/data", "tests/training", "tests/rollout", "tests/bridges", "-k", "nan or finite"],
    ),
    "hostile files": (
        "bytes of files of every format overwritten or cut, at random, 200 times each",
        "they are read, or refused by a sentence within 5 s",
        ["tests/fuzz_readers.py"],
    ),
    "repeated": (
        "the same training twice, with 0 and 2 loader processes; the same episodes in other orders and processes",
        "the same, bit for bit",
        ["tests/cli/test_fit.py", "tests/rollout/test_evaluate.py", "-k", "bit_for_bit or slots_or_history"],
    ),
    "physics": (
        "seeds again after other episodes, in another simulator and in another process",
        "the same joints, bit for bit",
        ["tests/sim/test_simulator.py", "tests/rollout/test_with_the_simulator.py", "-k", "same or repeat"],
    ),
    "round trips": (
        "demonstrations converted to each format and back",
        "the same states and actions; pictures within the codec's bound",
        ["tests/data/test_conversion.py", "-k", "exact"],
    ),
    "parity": (
        "our policy beside the original's arithmetic, aggregation beside the offline table, losses beside their sums",
        "the same numbers",
        ["tests/speed/test_reference_act.py", "tests/rollout/test_aggregation.py", "tests/models/test_losses.py"],
    ),
    "checkpoints": (
        "code in a checkpoint; round trips through every exported format",
        "refused, never run; the same actions",
        ["tests/models/test_checkpoint.py", "tests/cli/test_export.py"],
    ),
    "configs": (
        "every config parsed; misspelt keys and values",
        "each names its key",
        ["tests/cli/parsing/test_config.py"],
    ),
    "statistics": (
        "intervals and tests beside those of SciPy and statsmodels",
        "the same",
        ["tests/results"],
    ),
    "leaks": (
        "other validation episodes",
        "the statistics that a policy is given do not change",
        ["tests/data/test_statistics.py", "tests/data/test_split.py"],
    ),
}


def run_tests(arguments: list[str], folder: Path, number: int) -> str:
    """Run some tests in a process of their own.

    Raises:
        AssertionError: one failed, or none was found.
    """
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "--basetemp", str(folder / "t")]
    done = subprocess.run([*command, *arguments], cwd=ROOT, capture_output=True, text=True, check=False)
    last = done.stdout.strip().splitlines()[-1] if done.stdout.strip() else done.stderr[-300:]
    assert done.returncode == 0, done.stdout[-1500:]
    counts = re.search(r"(\d+) passed(?:.*?(\d+) skipped)?", last)
    assert counts is not None, last
    return f"{counts[1]} tests" + (f", {counts[2]} skipped" if counts[2] else "")


PIECES = [
    Piece(name, does, holds, 1, functools.partial(run_tests, arguments))
    for name, (does, holds, arguments) in SUITES.items()
]

"""`python -m ugr_lightning.sim.seeds --task NAME` recomputes the evaluation seeds of a task."""

import argparse
import sys

from ugr_lightning.errors import UGRError
from ugr_lightning.sim.seeds import write_evaluation_seeds
from ugr_lightning.sim.tasks import check_task, task_names


def main() -> int:
    """Recompute the seeds of the tasks given, or of all."""
    parser = argparse.ArgumentParser(prog="python -m ugr_lightning.sim.seeds", description=__doc__)
    parser.add_argument("--task", action="append", help="a task name; may be repeated; default: all tasks")
    tasks = parser.parse_args().task or task_names()
    try:
        for task in tasks:
            check_task(task)
        for task in tasks:
            print(write_evaluation_seeds(task))
    except UGRError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

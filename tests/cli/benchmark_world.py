"""`ugr` with a simulator without physics, for jobs that run in processes of their own and are killed there.

KILL=fit:N ends the process by SIGKILL before the N-th training step, KILL=test:N after the N-th episode of a process.
"""

import os
import signal
import sys
from functools import partial

import torch
from fake_simulator import FakeSimulator
from tiny import TinyPolicy

from ugr_lightning.cli.main import main
from ugr_lightning.rollout import results, runner
from ugr_lightning.sim import render


def kill_in_training(at):
    losses, step = TinyPolicy.losses, [0]

    def counted(self, batch):
        step[0] += self.training
        if step[0] == at:
            os.kill(os.getpid(), signal.SIGKILL)
        return losses(self, batch)

    TinyPolicy.losses = counted


def kill_in_evaluation(at):
    append, count = results.append_result, [0]

    def counted(path, result):
        append(path, result)
        count[0] += 1
        if count[0] == at:
            os.kill(os.getpid(), signal.SIGKILL)

    results.append_result = counted


if __name__ == "__main__":
    torch.set_num_threads(1)
    part, _, number = os.environ.get("KILL", "").partition(":")
    if part == sys.argv[1]:
        {"fit": kill_in_training, "test": kill_in_evaluation}[part](int(number))
    runner.run_episodes = partial(runner.run_episodes, simulator=FakeSimulator)
    render.require_rendering = lambda: None
    sys.exit(main(sys.argv[1:]))

import csv
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
import tiny
import torch
from tiny import train

TINY = Path(tiny.__file__)


def weights(folder):
    content = torch.load(folder / "last.ckpt", weights_only=True)
    return {
        f"{part}.{name}": value
        for part in ("state_dict", "training_state_dict")
        for name, value in content[part].items()
    }


def same(a, b):
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def rows(folder):
    return list(csv.DictReader((folder / "metrics.csv").open()))


@pytest.mark.parametrize("limit", ["max_steps", "max_epochs"])
def test_a_resumed_run_is_the_uninterrupted_one(tmp_path, limit):
    part, whole = (2, 4) if limit == "max_epochs" else (10, 20)  # an epoch is five steps
    straight, broken = tmp_path / "a" / "version_0", tmp_path / "b" / "version_0"
    train(straight, **{limit: whole})
    train(broken, **{limit: part})
    train(broken, **{limit: whole}, ckpt_path=broken / "last.ckpt")
    assert same(weights(straight), weights(broken))
    assert rows(straight) == rows(broken), "the log goes on as if nothing had happened"
    best = [torch.load(folder / "policy_best.ckpt")["global_step"] for folder in (straight, broken)]
    assert best[0] == best[1]


def test_a_killed_and_resumed_run_is_the_uninterrupted_one(tmp_path):
    straight, killed = tmp_path / "a" / "version_0", tmp_path / "b" / "version_0"
    steps = 300
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(
        [sys.executable, str(TINY), str(killed), "1000000"], env=environment, stderr=subprocess.DEVNULL
    )
    deadline = time.monotonic() + 600  # it is only there to end a test that hangs
    try:
        while not (killed / "policy_best.ckpt").exists():
            assert process.poll() is None
            assert time.monotonic() < deadline
    finally:
        process.kill()
        process.wait()
    reached = torch.load(killed / "last.ckpt", weights_only=True)["global_step"]
    steps = reached + 10
    command = [sys.executable, str(TINY), str(killed), str(steps), str(killed / "last.ckpt")]
    subprocess.run(command, env=environment, check=True, timeout=600, stderr=subprocess.DEVNULL)
    train(straight, max_steps=steps)
    assert same(weights(straight), weights(killed))

import os
import subprocess
import sys
import time
from pathlib import Path

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
    a, b = weights(straight), weights(killed)
    assert a.keys() == b.keys()
    assert all(torch.equal(a[name], b[name]) for name in a)

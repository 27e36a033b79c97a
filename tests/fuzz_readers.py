"""Random damage to good files of every format; not part of the tests: `make fuzz`."""

import contextlib
import shutil
import time

import numpy as np
import pytest
from foreign_files import write_act, write_maniskill, write_robotwin

from ugr_lightning.data.conversion import convert
from ugr_lightning.data.inspection import inspect_demonstrations
from ugr_lightning.errors import UGRError

ROUNDS, SECONDS = 200, 5.0
SAMPLES = {
    "robotwin": lambda folder: write_robotwin(folder, count=1),
    "act": lambda folder: write_act(folder, count=1),
    "act, compressed": lambda folder: write_act(folder, count=1, compress=True),
    "maniskill": lambda folder: write_maniskill(folder, lengths=(12,)),
    "lerobot": lambda folder: _lerobot(folder),
}


def _lerobot(folder):
    convert(write_act(folder.with_name("source"), count=1), folder, "lerobot", rate=25)
    return folder


@pytest.mark.parametrize("sample", SAMPLES)
def test_overwritten_bytes_are_read_or_one_error_of_ours(sample, tmp_path):
    good, rng = SAMPLES[sample](tmp_path / "good"), np.random.default_rng(0)
    files = [path.relative_to(good) for path in good.rglob("*") if path.is_file()]
    for number in range(ROUNDS):
        folder = shutil.copytree(good, tmp_path / str(number))
        path = folder / files[int(rng.integers(len(files)))]
        content = bytearray(path.read_bytes())
        at = int(rng.integers(len(content)))
        content[at : at + 16] = rng.bytes(16)
        path.write_bytes(content[: int(rng.integers(len(content)))] if number % 5 == 0 else content)
        start = time.monotonic()
        with contextlib.suppress(UGRError):
            inspect_demonstrations(folder)
        assert time.monotonic() - start < SECONDS
        shutil.rmtree(folder)

import json
import subprocess
import sys
from pathlib import Path

import pytest
from torch.utils import backend_registration

SCRIPT = Path(__file__).with_name("another_device.py")


@pytest.fixture(scope="module")
def found():
    """What went wrong on a device that is not the CPU, by policy."""
    if not hasattr(backend_registration, "_DummyBackendModule"):
        pytest.skip("this torch cannot register a device that is written in Python")
    done = subprocess.run([sys.executable, str(SCRIPT)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_every_policy_trains_and_acts_on_the_device_where_it_is(found):
    assert {"base", "cmask", "full", "block", "uncert", "dp", "uncert_held_out", "demo"} <= found.keys()
    assert {name: error for name, error in found.items() if error and name != "stray"} == {}


def test_a_tensor_that_stays_on_the_cpu_is_found(found):
    assert "two devices, cpu and gadget" in found["stray"]

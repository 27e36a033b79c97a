import numpy as np
import pytest

from ugr_lightning.sim.sapien_simulator import SapienSimulator

TINY = (30, 40)


@pytest.fixture(scope="session")
def click():
    with SapienSimulator("click_alarmclock", image_size=TINY) as simulator:
        yield simulator


@pytest.fixture(scope="session")
def handover():
    with SapienSimulator("handover_block", image_size=TINY, render=False) as simulator:
        yield simulator


@pytest.fixture(scope="session")
def holds_within():
    """Whether a condition on an offset (3,) holds up to these limits along each axis, both ways, and not beyond."""

    def holds(condition, limits):
        for axis, limit in enumerate(limits):
            for sign in (-1.0, 1.0):
                inside, outside = (sign * (limit + by) * np.eye(3)[axis] for by in (-0.001, 0.001))
                assert condition(inside)
                assert not condition(outside)
        return True

    return holds

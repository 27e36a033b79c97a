"""Reach the goal; on the seeds on which the expert gives up, it says why."""

from fake_simulator import FakeSimulator as FakeOutsideSimulator


class OutOfReach(FakeOutsideSimulator):
    version = 1

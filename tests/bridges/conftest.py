import pytest

from ugr_lightning.rollout.evaluate import run_episodes
from ugr_lightning.rollout.simulators import Simulators
from ugr_lightning.rollout.spec import RolloutSpec


@pytest.fixture(scope="module")
def rolled_out(fake_tasks):
    """What our own rollout makes of some seeds, in one process for all tests: (success, steps, motion hash) by seed."""
    with Simulators() as simulators:

        def roll(policy, seeds, execution):
            spec = RolloutSpec("reach", seeds, image_size=(30, 40), execution=execution, workers=1, progress=False)
            results = run_episodes(policy.for_inference(), spec, simulators=simulators)
            return {result.seed: (result.success, result.steps, result.motion_hash) for result in results}

        yield roll

"""What all tests share: one thread each, and an honest skip where this machine cannot render."""

import os
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest
import torch

from ugr_lightning.sim.render import RenderProbe, probe_rendering


@pytest.fixture(autouse=True)
def one_thread():
    """Each test starts with one thread, also after a command that took all cores."""
    torch.set_num_threads(1)


def _probe() -> RenderProbe:
    return probe_rendering(300)  # a crowded machine is slow, and not without a driver


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Skip tests marked `renders` where no driver works; UGR_REQUIRE_RENDERING=1, as in CI, lets them fail instead."""
    rendering = [item for item in items if item.get_closest_marker("renders")]
    if not rendering or os.environ.get("UGR_REQUIRE_RENDERING") == "1" or _probe().ok:
        return
    for item in rendering:
        item.add_marker(pytest.mark.skip(reason=_probe().message))


@pytest.fixture(scope="module")
def fake_tasks():
    """The tasks of `fake_simulator` have names, here and in processes that are started: as those of a user have."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("UGR_TASKS", str(Path(__file__).parent / "stand_ins" / "tasks"))
        yield

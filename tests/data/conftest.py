import pytest
from recordings import arrays, record

from ugr_lightning.data.folder import episode_path
from ugr_lightning.data.formats.robotwin import write_episode


@pytest.fixture
def episode_file(tmp_path):
    """One good episode file of 12 steps."""
    path = episode_path(tmp_path, 0)
    write_episode(path, **arrays())
    return path


@pytest.fixture(scope="session")
def recording_root(tmp_path_factory):
    """Root folder with five episodes of click_alarmclock; not to be changed."""
    root = tmp_path_factory.mktemp("recordings")
    record(root)
    return root

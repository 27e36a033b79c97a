import re

import pytest
from PIL import Image

from ugr_lightning.demos.gallery import GIF_BYTES, make_gallery
from ugr_lightning.errors import SimulationError

pytestmark = pytest.mark.usefixtures("fake_tasks")

SETTINGS = ("demo_clean", "demo_randomized")


def gallery(folder, tasks, **more):
    given = {"image_size": (24, 32), "workers": 1} | more
    return make_gallery(folder, tasks, SETTINGS, **given)


def test_the_page_shows_a_gif_and_stills_of_every_task_in_every_setting(tmp_path):
    page = gallery(tmp_path, ["reach", "hang"], first_seed=3)  # the expert gives up on 3
    text = page.read_text()
    shown = re.findall(r"\]\((.+?)\)", text)
    assert shown == [f"{task}-{setting}.{kind}" for task in ("reach", "hang") for setting in SETTINGS
                     for kind in ("gif", "jpg")]  # fmt: skip
    assert {path.name for path in tmp_path.iterdir()} == {"gallery.md", *shown}
    assert "seed 4, 12 control steps" in text
    with Image.open(tmp_path / "reach-demo_clean.gif") as film:
        assert film.n_frames == 13
        assert film.size == (3 * 128, 96)
    with Image.open(tmp_path / "reach-demo_clean.jpg") as stills:
        assert stills.size == (3 * 32, 3 * 24)
    assert all((tmp_path / name).stat().st_size < GIF_BYTES for name in shown)


def test_a_film_that_is_too_large_has_fewer_frames(tmp_path, monkeypatch):
    from ugr_lightning.demos import gallery as module

    photographer = module.Photographer(tmp_path, (24, 32), 0)
    photographer.shoot(("reach", "demo_clean"))
    size = (tmp_path / "reach-demo_clean.gif").stat().st_size
    monkeypatch.setattr(module, "GIF_BYTES", size - 1)
    monkeypatch.setattr(module, "FRAME_COUNTS", (60, 5))
    photographer.shoot(("reach", "demo_clean"))
    with Image.open(tmp_path / "reach-demo_clean.gif") as film:
        assert film.n_frames == 5


def test_an_expert_that_solves_nothing_is_an_error(tmp_path):
    with pytest.raises(SimulationError, match="no success on the seeds 0 to 9"):
        gallery(tmp_path, ["unsolvable"], first_seed=0)
    assert not (tmp_path / "gallery.md").exists()

import json

import numpy as np
import pytest

from ugr_lightning.errors import ConfigError
from ugr_lightning.sim import settings
from ugr_lightning.sim.settings import SETTINGS, check_setting, surroundings_of

LOOKS = [surroundings_of("demo_randomized", seed) for seed in range(400000, 400100)]


def test_the_clean_setting_is_the_same_in_every_episode_and_has_no_clutter():
    assert surroundings_of("demo_clean", 1) == surroundings_of("demo_clean", 2)
    assert surroundings_of("demo_clean", 1).clutter == ()
    assert surroundings_of("demo_clean", 1).table_drop == 0.0


def test_the_seed_decides_the_surroundings():
    assert surroundings_of("demo_randomized", 7) == surroundings_of("demo_randomized", 7)
    for name in settings.Surroundings._fields:
        assert len({str(getattr(look, name)) for look in LOOKS}) > 90, name


def test_light_colours_height_and_camera_stay_within_their_ranges():
    for look in LOOKS:
        lights = [look.ambient, *(light.colour for light in look.lights)]
        colours = np.array([look.table, look.wall, look.floor, *lights])
        assert ((colours >= 0) & (colours <= 1)).all()
        assert 0 <= look.table_drop <= settings.TABLE_DROP
        assert np.abs(np.subtract(look.camera_eye, settings.CAMERA_EYE)).max() <= settings.EYE_JITTER
        assert all(light.direction[2] < 0 for light in look.lights)  # from above
    drops = [look.table_drop for look in LOOKS]
    assert max(drops) - min(drops) > 0.8 * settings.TABLE_DROP


def test_clutter_stands_at_the_far_edge_of_the_table_each_piece_by_itself():
    kinds = set()
    for look in LOOKS:
        low, high = settings.CLUTTER_COUNT
        assert low <= len(look.clutter) <= high
        kinds |= {item.kind for item in look.clutter}
        places = np.array([(item.x, item.y, item.width / 2) for item in look.clutter])
        assert (np.abs(places[:, 0]) + places[:, 2] < settings.TABLE_SIZE[0] / 2).all()
        assert (places[:, 1] + places[:, 2] < settings.TABLE_SIZE[1] / 2).all()
        assert (places[:, 1] - places[:, 2] > 0.37).all()  # the props of all tasks end before
        for i, one in enumerate(places):
            for other in places[:i]:
                assert np.hypot(*(one - other)[:2]) > one[2] + other[2]
    assert kinds == set(settings.CLUTTER_KINDS)


def test_the_description_is_json():
    described = json.loads(json.dumps(LOOKS[0].describe()))
    assert described["table_drop"] == LOOKS[0].table_drop
    assert described["clutter"][0]["kind"] in settings.CLUTTER_KINDS
    assert len(described["lights"]) == 2


def test_an_unknown_setting_names_the_closest_one():
    with pytest.raises(ConfigError, match="Did you mean demo_randomized"):
        check_setting("demo_randomised")
    for name in SETTINGS:
        check_setting(name)

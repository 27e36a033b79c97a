import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image

from ugr_lightning.errors import ConfigError
from ugr_lightning.rollout.film import ARM_COLOURS, STRIP_HEIGHT, compose_frames, draw_keyframes, write_video


def images(steps=7):
    frames = np.zeros((steps, 3, 31, 40, 3), np.uint8)
    for view in range(3):
        frames[:, view, ..., view] = 200
    return list(frames)


def test_cameras_stand_side_by_side_in_their_order():
    frames = compose_frames(images())
    assert frames.shape == (7, 31, 120, 3)
    for view in range(3):
        assert frames[0, 28, 40 * view + 20].argmax() == view


def test_uncertainty_is_a_strip_below_brightest_where_largest():
    uncertainty = [None] + [np.array([-3.0, 1.0])] * 6
    frames = compose_frames(images(), log_variance=uncertainty)
    assert frames.shape == (7, 31 + STRIP_HEIGHT, 120, 3)
    assert frames[1, 35, 100].sum() > frames[1, 35, 10].sum()
    assert len(np.unique(frames[0, 35])) == 1


def test_success_is_marked_and_the_last_step_is_kept():
    frames = compose_frames(images(), success=[False] * 6 + [True], every=4)
    assert len(frames) == 3
    assert tuple(frames[-1, -1, -1]) == (40, 170, 70)
    assert tuple(frames[0, -1, -1]) == (0, 0, 200)


def test_an_alarm_is_marked_from_the_step_on_at_which_it_is_raised():
    frames = compose_frames(images(), alarm=3, success=[False] * 6 + [True])
    assert [tuple(frame[-1, -1]) for frame in frames] == [(0, 0, 200)] * 3 + [(220, 40, 40)] * 3 + [(40, 170, 70)]
    assert (frames[3, :14] != compose_frames(images(), alarm=4)[3, :14]).any(), "and written down"


def test_keyframes_glow_where_maps_are_high_and_stand_as_pins_where_the_camera_is_now():
    pictures = [np.full((1, 60, 80, 3), 100, np.uint8)] * 2
    maps = np.zeros((1, 2, 2, 15, 20))
    maps[0, 1, 1, 12, 2] = 0.4  # the right arm's foot, bottom left
    points = np.array([[[-0.5, 0, 1], [-0.5, 0.5, 1]], [[0.5, 0, -1], [0.5, 0.5, -1]]])  # the right one is behind
    ahead = np.eye(4, dtype=np.float32)[None, :3]
    aside = ahead + np.array([[0, 0, 0, 0.5], [0, 0, 0, 0], [0, 0, 0, 0]], np.float32)
    first, second = draw_keyframes(pictures, [maps], [points, points], [ahead, aside])
    glowing = first[0, 50, 10].astype(int) - 100
    assert np.abs(glowing).max() > 50
    assert (np.sign(glowing) == np.sign(np.array(ARM_COLOURS[1]) - 100)).all()
    assert tuple(first[0, 30, 20]) == tuple(first[0, 40, 20]) == ARM_COLOURS[0]
    assert tuple(second[0, 30, 40]) == ARM_COLOURS[0]  # the camera has moved, the pin has not
    assert (second[0, 50, 10] == 100).all()  # asked in the first step only
    assert (first[0, 25:35, 55:65] == 100).all()


def test_a_policy_that_looks_for_no_keyframes_leaves_pictures_as_they_are():
    pictures = images()
    assert draw_keyframes(pictures, [None] * 6, [None] * 7, [None] * 7) is pictures


def test_gif_has_all_frames_at_the_right_speed(tmp_path):
    write_video(tmp_path / "new" / "a.gif", compose_frames(images()), fps=12.5)
    with Image.open(tmp_path / "new" / "a.gif") as gif:
        assert (gif.n_frames, gif.size, gif.info["duration"]) == (7, (120, 31), 80)
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["a.gif"]


def test_wide_films_are_halved_as_gif_and_still_say_the_step(tmp_path):
    wide = np.zeros((2, 3, 240, 320, 3), np.uint8)
    write_video(tmp_path / "a.gif", compose_frames(list(wide), success=[False, True]))
    with Image.open(tmp_path / "a.gif") as gif:
        said = np.asarray(gif.convert("RGB"))
        assert said.shape == (120, 480, 3)
        assert (said[:14, :14].max(axis=(1, 2)) > 90).sum() >= 7, "a digit is so many pixels high"
        gif.seek(1)
        assert np.asarray(gif.convert("RGB"))[60, 0, 1] > 150


def test_the_frame_of_a_success_is_green_in_a_gif_whose_other_pictures_have_no_green(tmp_path):
    shades = np.random.default_rng(0).integers(90, 200, (40, 3, 60, 80, 1), dtype=np.uint8)
    pictures = list(np.repeat(shades, 3, axis=-1))
    write_video(tmp_path / "a.gif", compose_frames(pictures, success=[False] * 38 + [True] * 2))
    with Image.open(tmp_path / "a.gif") as gif:
        gif.seek(39)
        red, green, blue = np.asarray(gif.convert("RGB"))[30, 0].astype(int)
    assert green > 1.5 * max(red, blue)


def test_mp4_plays_even_with_odd_sizes(tmp_path):
    write_video(tmp_path / "a.mp4", compose_frames(images()), fps=25)
    reader = imageio_ffmpeg.read_frames(str(tmp_path / "a.mp4"))
    assert next(reader)["size"] == (120, 32)
    assert len(list(reader)) == 7


@pytest.mark.parametrize(("name", "count"), [("a.avi", 3), ("a", 3), ("a.gif", 0)])
def test_another_ending_or_no_frames_is_refused(tmp_path, name, count):
    with pytest.raises(ConfigError, match=r"gif or|frames"):
        write_video(tmp_path / name, np.zeros((count, 8, 8, 3), np.uint8))

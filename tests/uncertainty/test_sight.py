import numpy as np

from ugr_lightning.uncertainty.predictions import Predictions
from ugr_lightning.uncertainty.sight import sight_of_keyframes, sight_table

K = 4
FAR = 100  # the right arm's only keyframe, more than a chunk ahead of all that is looked at


def predictions(missed, keyframe, episode, step):
    """Of the left arm; the right one is never asked."""
    error = np.zeros((len(step), K))
    two = np.array([[distance, 1.0] for distance in missed]), np.array([[at, FAR] for at in keyframe])
    return Predictions(error, error, None, None, np.array(episode), np.array(step), *two)


NEW = predictions([0.001, 0.003, 0.010, 0.030], [4, 5, 7, 9], [0, 1, 0, 1], [0, 1, 4, 5])
KNOWN = predictions([0.002, 0.004], [4, 8], [2, 2], [0, 4])


def test_keyframes_are_told_apart_by_their_number_though_they_come_at_other_steps_in_each_episode():
    first, second, other = sight_of_keyframes(NEW, KNOWN)
    assert (first.arm, first.keyframe, first.step) == ("left", 1, 4)
    assert (second.arm, second.keyframe, second.step) == ("left", 2, 8)
    np.testing.assert_allclose([first.new, first.known], [(2.0, 2.8), (2.0, 2.0)])
    np.testing.assert_allclose([second.new, second.known], [(20.0, 28.0), (4.0, 4.0)])
    assert (other.arm, other.keyframe) == ("right", 1)


def test_what_is_further_ahead_than_a_chunk_does_not_count():
    """Far ahead nothing is done with it yet."""
    far = predictions([0.5, 0.001], [9, 9], [0, 0], [4, 5])
    seen, never = sight_of_keyframes(far, far)
    assert seen.new == (1.0, 1.0)
    assert np.isnan(never.new).all()


def test_a_policy_that_does_not_look_for_keyframes_has_no_sight():
    blind = NEW._replace(missed=None, keyframe=None)
    assert sight_of_keyframes(blind, blind) == []


def test_the_table_has_a_row_for_each_keyframe_and_both_kinds_of_scenes():
    head, *rows = sight_table(sight_of_keyframes(NEW, KNOWN))
    assert len(head) == 5
    assert rows[1] == ("left", "2", "8", "20.0 / 28.0 mm", "4.0 / 4.0 mm")
    assert rows[2][3:] == ("never near", "never near")

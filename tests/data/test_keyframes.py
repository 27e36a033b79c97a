from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ugr_lightning.data.formats.robotwin import read_episode
from ugr_lightning.data.keyframes import first_axes, keyframe_labels, missing_for_keyframes, next_keyframes


def test_a_keyframe_is_where_the_gripper_changes_while_the_hand_rests_or_the_end():
    commands = np.zeros((8, 7))
    commands[:, 6] = [1, 1, 1, 0, 0, 0, 1, 1]  # closes in step 3, opens in step 6
    assert next_keyframes(commands).tolist() == [3, 3, 3, 6, 6, 6, 8, 8]
    commands[3:, 2] = 0.01  # the arm moves while the gripper closes: on the way, not a keyframe
    assert next_keyframes(commands).tolist() == [6] * 6 + [8, 8]


def test_axes_are_the_columns_of_the_rotation():
    rotation = Rotation.random(5, random_state=0)
    x, y, z, w = rotation.as_quat().T
    columns = np.concatenate([rotation.as_matrix()[:, :, 0], rotation.as_matrix()[:, :, 1]], 1)
    assert first_axes(np.stack([w, x, y, z], 1)) == pytest.approx(columns)


def test_labels_are_the_poses_at_the_next_keyframes(episode_file):
    episode = read_episode(episode_file)
    position, axes, delay = keyframe_labels(episode)
    assert (position.shape, axes.shape, delay.shape) == ((12, 2, 3), (12, 2, 6), (12, 2))
    step, arm = 4, 1
    assert position[step, arm] == pytest.approx(episode.endpose[step + delay[step, arm], arm, :3], abs=1e-6)
    assert (delay >= 1).all()
    assert (delay + np.arange(12)[:, None] <= 12).all()


@pytest.mark.parametrize("missing", ["endpose", "projection"])
def test_a_demonstration_without_poses_or_calibration_has_no_labels(episode_file, missing):
    assert keyframe_labels(replace(read_episode(episode_file), **{missing: None})) is None


@pytest.mark.parametrize("unfilled", ["endpose", "projection"])
def test_poses_and_calibration_that_nobody_filled_in_are_missing(episode_file, unfilled):
    episode = read_episode(episode_file)
    assert missing_for_keyframes(episode) == []
    values = getattr(episode, unfilled).copy()
    values[3] = 0
    changed = replace(episode, **{unfilled: values})
    (said,) = missing_for_keyframes(changed)
    assert "filled in" in said
    assert keyframe_labels(changed) is None

"""Statistics come from the real steps of training episodes and from nothing else."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from recordings import arrays, record

from ugr_lightning.data.datamodule import ChunkDataModule
from ugr_lightning.data.episode import Episode
from ugr_lightning.data.folder import episode_path
from ugr_lightning.data.formats.robotwin import read_episode, write_episode
from ugr_lightning.data.statistics import compute_statistics
from ugr_lightning.errors import DataError


def _episodes(root, count=3):
    return [read_episode(episode_path(root / "click_alarmclock" / "demo_clean", i)) for i in range(count)]


def test_statistics_are_those_of_the_concatenated_training_rows(recording_root):
    episodes = _episodes(recording_root)
    got = compute_statistics(episodes, [0, 2])
    states = np.concatenate([episodes[0].state, episodes[2].state]).astype(np.float64)
    actions = np.concatenate([episodes[0].action, episodes[2].action]).astype(np.float64)
    for rows, found in ((states, got[:4]), (actions, got[4:8])):
        expected = rows.mean(0), rows.std(0, ddof=1), rows.min(0), rows.max(0)
        for want, have in zip(expected, found, strict=True):
            assert have.dtype == torch.float32
            np.testing.assert_array_equal(have.numpy(), want.astype(np.float32))


def test_measured_statistics_are_those_of_the_measured_joints(recording_root):
    episodes = _episodes(recording_root)
    got = compute_statistics(episodes, state="measured").state_mean
    rows = np.concatenate([episode.measured for episode in episodes]).astype(np.float64)
    np.testing.assert_array_equal(got.numpy(), rows.mean(0).astype(np.float32))


def test_keyframes_have_statistics_where_every_episode_has_them_also_those_that_validate(recording_root):
    episodes = _episodes(recording_root)
    assert compute_statistics(episodes, [0, 2]).keyframe_mean is not None
    without = [episodes[0], replace(episodes[1], endpose=None), episodes[2]]
    assert compute_statistics(without, [0, 2]).keyframe_mean is None


def test_a_joint_that_never_moves_gets_the_smallest_deviation(recording_root):
    episode: Episode = _episodes(recording_root)[0]
    still = replace(episode, state=np.full_like(episode.state, 0.3))
    found = compute_statistics([still])
    assert (found.state_std == torch.tensor(0.01)).all()
    assert (found.action_std > 0.01).all()


def test_small_differences_on_a_large_offset_survive(recording_root):
    episode = _episodes(recording_root)[0]
    rows = np.repeat(np.arange(4000, dtype=np.float32)[:, None] % 2, 14, axis=1) + 30_000
    found = compute_statistics([replace(episode, state=rows)]).state_std
    assert torch.allclose(found, torch.tensor(0.5), atol=1e-3)


def test_changing_validation_episodes_leaves_statistics_bit_identical(tmp_path):
    folder = record(tmp_path)

    def statistics():
        data = ChunkDataModule(root=str(tmp_path), episodes=5, cache="none")
        data.setup()
        return data.episode_split, data.statistics

    split, before = statistics()
    for index in split.validation:
        write_episode(episode_path(folder, index), **arrays(steps=9, seed=99))
    assert all(torch.equal(a, b) for a, b in zip(before, statistics()[1], strict=True))
    write_episode(episode_path(folder, split.train[0]), **arrays(steps=9, seed=99))
    assert not torch.equal(before.state_mean, statistics()[1].state_mean)


def test_no_training_episode_is_an_error():
    with pytest.raises(DataError, match="at least one training episode"):
        compute_statistics([])

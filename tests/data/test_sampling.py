"""An epoch is a pure function of (seed, epoch, index), and processes share it without loss or repetition."""

import numpy as np
import pytest

from ugr_lightning.data.sampling import BatchSampler, Frames, Sampling, deal
from ugr_lightning.errors import ConfigError

FRAMES = Frames([7, 10, 13, 16])
TRAIN = (0, 2, 3)
ALL = set(range(7)) | set(range(17, 46))


def test_frames_are_numbered_through_all_episodes():
    assert len(FRAMES) == 46
    episode, step = FRAMES.locate(np.array([0, 6, 7, 16, 17, 45]))
    assert episode.tolist() == [0, 0, 1, 1, 2, 3]
    assert step.tolist() == [0, 6, 0, 9, 0, 15]


def test_the_validation_grid_starts_each_episode_at_its_first_frame():
    assert FRAMES.of((1, 3), stride=4).tolist() == [7, 11, 15, 30, 34, 38, 42]


def test_a_uniform_epoch_is_every_training_frame_once():
    drawn = FRAMES.draw(TRAIN, Sampling(), seed=0, epoch=0)
    assert sorted(drawn.tolist()) == sorted(ALL)
    assert drawn.tolist() != sorted(ALL)


def test_the_same_seed_and_epoch_give_the_same_samples_and_others_give_others():
    for sampling in (Sampling(), Sampling("per_episode", 9, 0.3)):
        first = FRAMES.draw(TRAIN, sampling, 5, 3)
        FRAMES.draw(TRAIN, sampling, 5, 4)
        np.random.seed(0)
        np.testing.assert_array_equal(FRAMES.draw(TRAIN, sampling, 5, 3), first)
        assert not np.array_equal(FRAMES.draw(TRAIN, sampling, 5, 4), first)
        assert not np.array_equal(FRAMES.draw(TRAIN, sampling, 6, 3), first)


@pytest.mark.parametrize("count", [1, 20, 36, 100])
def test_a_fixed_number_of_samples_repeats_none_before_all_were_seen(count):
    drawn = FRAMES.draw(TRAIN, Sampling(samples_per_epoch=count), 0, 0)
    assert len(drawn) == count
    times = np.unique(drawn, return_counts=True)[1]
    assert times.max() == -(-count // 36)
    assert times.max() - (times.min() if count >= 36 else 0) <= 1


def test_per_episode_draws_one_frame_of_every_training_episode():
    seen = set()
    for epoch in range(200):
        drawn = FRAMES.draw(TRAIN, Sampling("per_episode"), 0, epoch)
        assert sorted(FRAMES.locate(drawn)[0].tolist()) == [0, 2, 3]
        seen |= set(drawn.tolist())
    assert seen == ALL


def test_the_share_of_first_frames_is_as_asked():
    sampling = Sampling(samples_per_epoch=20_000, first_frame_share=0.25)
    drawn = FRAMES.draw(TRAIN, sampling, 0, 0)
    episode, step = FRAMES.locate(drawn)
    assert abs((step == 0).mean() - (0.25 + 0.75 * 3 / 36)) < 0.01
    assert set(episode[step == 0].tolist()) == {0, 2, 3}
    only = FRAMES.draw(TRAIN, Sampling(first_frame_share=1.0), 0, 0)
    assert set(only.tolist()) == {0, 17, 30}


RESTING = np.array([0, 0, 0, 2, 2, 2.5, 4, 6, 0, 1, 1, 1, 2, 2, 2])[:, None] * [1, 0.5]  # 8 and 7 frames


@pytest.mark.parametrize(
    ("rest", "expected"),
    [
        (0.1, [0, 2, 2, 4, 4, 5, 6, 7, 8, 11, 11, 11, 12, 13, 14]),
        (0.6, [0, 2, 2, 5, 5, 5, 6, 7, 8, 11, 11, 11, 12, 13, 14]),  # as far as from each frame itself
        (1.1, [0, 2, 2, 5, 5, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14]),  # the second rests until its end
        (0.0, list(range(15))),
    ],
)
def test_what_stands_for_a_rest_is_its_last_frame(rest, expected):
    assert Frames([8, 7]).after_rest(RESTING, rest).tolist() == expected


def test_no_episode_rests_into_the_next_one_or_before_its_first_frame():
    states = np.zeros((46, 14))
    assert FRAMES.after_rest(states, 1.0).tolist() == list(range(46))
    states[6::7, 3] = 1.0
    stands = FRAMES.after_rest(states, 0.5)
    np.testing.assert_array_equal(FRAMES.locate(stands)[0], FRAMES.locate(np.arange(46))[0])
    assert stands[FRAMES.starts].tolist() == FRAMES.starts.tolist()


IMPOSSIBLE = [{"mode": "all"}, {"samples_per_epoch": 0}, {"first_frame_share": 1.1}, {"rest": -0.1}, {"rest": np.inf}]


@pytest.mark.parametrize("options", IMPOSSIBLE)
def test_impossible_sampling_is_refused(options):
    with pytest.raises(ConfigError, match=next(iter(options))):
        Sampling(**options)


@pytest.mark.parametrize("replicas", [1, 2, 3, 8])
@pytest.mark.parametrize("batch_size", [1, 2, 8, 16])
@pytest.mark.parametrize("count", [8, 9, 16, 17, 33, 64, 100])
def test_processes_see_every_sample_exactly_once_in_equally_many_batches(count, batch_size, replicas):
    order = np.random.default_rng(0).permutation(count)
    dealt = [deal(order, batch_size, replicas, rank) for rank in range(replicas)]
    assert len({len(batches) for batches in dealt}) == 1
    assert all(len(batch) >= 1 for batches in dealt for batch in batches)
    assert max(len(batch) for batches in dealt for batch in batches) <= batch_size + 1
    seen = np.concatenate([batch for batches in dealt for batch in batches])
    assert sorted(seen.tolist()) == list(range(count))


def test_one_process_gets_full_batches_and_a_smaller_last_one():
    assert [len(batch) for batch in deal(np.arange(35), 8, 1, 0)] == [8, 8, 8, 8, 3]


def test_two_processes_share_what_one_process_would_see_in_a_batch_of_twice_the_size():
    order = np.random.default_rng(0).permutation(64)
    alone = deal(order, 16, 1, 0)
    pair = [deal(order, 8, 2, rank) for rank in range(2)]
    for whole, left, right in zip(alone, *pair, strict=True):
        assert sorted(whole.tolist()) == sorted([*left.tolist(), *right.tolist()])


def _order(epoch):
    return FRAMES.draw(TRAIN, Sampling(), 0, epoch)


def test_the_sampler_follows_the_epoch_it_is_told():
    sampler = BatchSampler(_order, 8)
    first = list(sampler)
    assert list(sampler) == first
    assert len(sampler) == len(first) == 5
    sampler.set_epoch(1)
    assert list(sampler) == [batch.tolist() for batch in deal(_order(1), 8, 1, 0)] != first


def test_the_epoch_counts_as_of_the_moment_iteration_begins():
    sampler = BatchSampler(_order, 8)
    running = iter(sampler)
    sampler.set_epoch(1)
    assert list(running) == [batch.tolist() for batch in deal(_order(0), 8, 1, 0)]


def test_a_resumed_sampler_skips_what_was_trained_on_in_that_epoch_only():
    whole, resumed = BatchSampler(_order, 8), BatchSampler(_order, 8)
    resumed.resume(2, 3)
    for epoch, skipped in ((2, 3), (3, 0)):
        whole.set_epoch(epoch)
        resumed.set_epoch(epoch)
        assert list(resumed) == list(whole)[skipped:]
    assert len(resumed) == len(whole)


def test_more_processes_than_samples_are_refused():
    with pytest.raises(ConfigError, match="at most 36 processes"):
        BatchSampler(_order, 8, replicas=37)

import torch

from ugr_lightning.training.callbacks.rng import CounterSeeds, counter_seed


class Trainer:
    current_epoch, global_rank = 2, 0


def draw(batch_idx, seed=0):
    CounterSeeds(seed).on_train_batch_start(Trainer(), None, None, batch_idx)
    return torch.rand(4)


def test_random_numbers_depend_on_the_counters_and_on_nothing_else():
    first = draw(3)
    torch.rand(100)
    assert torch.equal(first, draw(3))
    assert not torch.equal(first, draw(4))
    assert not torch.equal(first, draw(3, seed=1))


def test_no_two_counters_share_a_seed():
    seeds = {counter_seed(0, epoch, batch, rank) for epoch in range(20) for batch in range(20) for rank in range(4)}
    assert len(seeds) == 1600

"""The contract of every selector that is found in the package, and what each of them adds."""

import importlib
import inspect
import pkgutil
from pathlib import Path

import pytest
import torch

from ugr_lightning.blueprint import rebuild
from ugr_lightning.errors import ConfigError
from ugr_lightning.models import refine
from ugr_lightning.models.refine.block import Block
from ugr_lightning.models.refine.full import Full
from ugr_lightning.models.refine.head import Head
from ugr_lightning.models.refine.scattered import Scattered
from ugr_lightning.models.refine.selector import Selector, checked_budget
from ugr_lightning.models.refine.tail import Tail
from ugr_lightning.models.refine.uncertainty import Uncertainty

CONFIGS = Path(__file__).parents[3] / "configs"
STEPS = 50


def discovered() -> list[type[Selector]]:
    found = []
    for module in pkgutil.iter_modules(refine.__path__, refine.__name__ + "."):
        for _, item in inspect.getmembers(importlib.import_module(module.name), inspect.isclass):
            if issubclass(item, Selector) and not inspect.isabstract(item) and item.__module__ == module.name:
                found.append(item)
    return found


every_selector = pytest.mark.parametrize("kind", discovered(), ids=lambda kind: kind.__name__)


def scores(batch: int = 6) -> torch.Tensor:
    return torch.randn(batch, STEPS, generator=torch.Generator().manual_seed(0))


def whole(batch: int = 6) -> torch.Tensor:
    return torch.ones(batch, STEPS, dtype=torch.bool)


def test_the_selectors_of_the_paper_and_the_controls_are_discovered():
    assert {Full, Block, Uncertainty, Head, Tail, Scattered} <= set(discovered())


@every_selector
def test_has_a_yaml_that_trains_it(kind):
    named = f"class_path: {kind.__module__}.{kind.__name__}\n"
    assert any(named in path.read_text() for path in CONFIGS.rglob("*.yaml"))


@every_selector
def test_chooses_known_steps_for_each_sample_by_itself_at_run_time_and_leaves_the_random_state_alone(kind):
    selector, state = kind(), torch.get_rng_state()
    valid = torch.arange(STEPS)[None] < torch.tensor([50, 40, 20, 14, 3, 1])[:, None]
    together = selector.select(scores(), valid, False)
    alone = [selector.select(s[None], v[None], False) for s, v in zip(scores(), valid, strict=True)]
    assert torch.equal(together, torch.cat(alone))
    assert not (together & ~valid).any()
    assert torch.equal(state, torch.get_rng_state())


@every_selector
def test_does_not_change_its_inputs(kind):
    log_variance, valid = scores(), whole()
    kind().select(log_variance, valid, True)
    assert torch.equal(log_variance, scores())
    assert torch.equal(valid, whole())


@every_selector
def test_works_without_log_variance_unless_it_says_it_needs_it(kind):
    if kind.needs_uncertainty:
        with pytest.raises(ConfigError):
            kind().select(None, whole(), False)
    else:
        assert kind().select(None, whole(), False).shape == (6, STEPS)


@every_selector
def test_is_rebuilt_from_its_blueprint(kind):
    again = rebuild(kind().blueprint())
    assert type(again) is kind
    assert torch.equal(again.select(scores(), whole(), False), kind().select(scores(), whole(), False))


@every_selector
@pytest.mark.parametrize("steps", [STEPS, 13])
def test_keeps_its_promises_and_leaves_the_random_state_alone(kind, steps):
    selector, state = kind(), torch.get_rng_state()
    assert checked_budget(selector, steps, uncertain=True) == selector.budget(steps)
    assert torch.equal(state, torch.get_rng_state())
    in_training = selector.select(scores()[:, :steps], whole()[:, :steps], True).sum(1)
    assert set(in_training.tolist()) <= {selector.budget(steps)}, "as many in training"


class Mine(Selector):
    """A rule of a user's, given as a function."""

    def __init__(self, budget: int | None = 5) -> None:
        super().__init__()
        self.steps = budget

    def budget(self, chunk_length):
        return self.steps

    def select(self, log_variance, valid, training):
        return self.rule(log_variance, valid)


FIRST = torch.arange(10) < 5


@pytest.mark.parametrize(
    ("rule", "complaint"),
    [
        (lambda s, valid: (FIRST & valid).float(), r"Mine.select: expected bool \(2, 10\), .* got float32 \(2, 10\)"),
        (lambda s, valid: FIRST, r"got bool \(10,\)\. Return a truth value for each step of each sample"),
        (lambda s, valid: None, "got None"),
        (lambda s, valid: s > 0, r"got TypeError: .*test_selectors.*`needs_uncertainty = True`"),
        (lambda s, valid: valid.clone(), "expected 5 chosen steps in every chunk, as `budget` promises, got 10"),
        (lambda s, valid: FIRST.expand(valid.shape) & valid | ~valid, "expected no padded step chosen, got 5 of them"),
        (lambda s, valid: torch.rand(valid.shape).argsort(1) < 5, "expected the same choice whenever it is asked"),
    ],
)
def test_a_rule_that_breaks_a_promise_is_refused_in_a_sentence(rule, complaint, monkeypatch):
    monkeypatch.setattr(Mine, "rule", staticmethod(rule), raising=False)
    with pytest.raises(ConfigError, match=complaint):
        checked_budget(Mine(), 10, uncertain=False)


@pytest.mark.parametrize("budget", [11, 2.5])
def test_a_budget_that_is_no_number_of_steps_is_refused(budget):
    with pytest.raises(ConfigError, match=rf"Mine.budget: expected a whole number of steps up to 10.*got {budget}"):
        checked_budget(Mine(budget), 10, uncertain=False)


def test_full_chooses_all_valid_steps():
    assert Full().select(None, whole(), True).all()


def test_block_is_one_run_in_the_middle_at_run_time():
    mask = Block(12).select(None, whole(1), False)[0]
    assert mask.nonzero().flatten().tolist() == list(range(19, 31))


def test_block_starts_anywhere_in_training_and_differs_between_samples():
    mask = Block(12).select(None, whole(4000), True)
    first = mask.int().argmax(1)
    assert mask.sum(1).eq(12).all()
    assert (mask.int().diff(dim=1) == 1).sum(1).le(1).all()  # one run
    assert first.unique().tolist() == list(range(39))
    assert first.bincount().min() > 50  # uniform would be 103 each


def test_block_longer_than_the_chunk_is_refused():
    with pytest.raises(ConfigError, match="chunk"):
        Block(51).budget(50)


def test_uncertainty_chooses_fifteen_of_fifty_and_they_are_the_highest():
    mask = Uncertainty().select(scores(), whole(), False)
    assert mask.sum(1).tolist() == [15] * 6
    for row, chosen in zip(scores(), mask, strict=True):
        assert row[chosen].min() > row[~chosen].max()


def test_uncertainty_breaks_ties_towards_earlier_steps():
    log_variance = torch.zeros(1, STEPS)
    log_variance[0, 40] = 1
    chosen = Uncertainty().select(log_variance, whole(1), False)[0].nonzero().flatten().tolist()
    assert chosen == [*range(14), 40]


def test_uncertainty_spends_its_budget_on_valid_steps_even_if_padded_ones_score_higher():
    valid = torch.arange(STEPS)[None] < 30
    chosen = Uncertainty().select(torch.arange(STEPS).float()[None], valid, True)[0].nonzero().flatten().tolist()
    assert chosen == list(range(15, 30))


@pytest.mark.parametrize("ratio", [0, -0.1, 1.1])
def test_a_ratio_that_is_no_share_is_refused(ratio):
    with pytest.raises(ConfigError, match="ratio"):
        Uncertainty(ratio)


def test_a_ratio_that_selects_nothing_is_refused():
    with pytest.raises(ConfigError, match="at least one"):
        Uncertainty(0.01).budget(50)


def chosen(selector: Selector, valid: torch.Tensor | None = None, training: bool = False) -> list[int]:
    return selector.select(None, whole(1) if valid is None else valid, training)[0].nonzero().flatten().tolist()


def test_head_and_tail_choose_the_ends_of_what_is_valid():
    valid = torch.arange(STEPS)[None] < 30
    assert chosen(Head()) == chosen(Head(), valid) == list(range(15))
    assert chosen(Tail()) == list(range(35, 50))
    assert chosen(Tail(), valid) == list(range(15, 30))


def test_scattered_draws_anew_for_each_sample_in_training_and_once_for_all_at_run_time():
    masks = Scattered().select(None, whole(2000), True)
    assert masks.sum(1).eq(15).all()
    assert masks.float().mean(0).sub(0.3).abs().max() < 0.06  # every position is equally likely
    assert Scattered().select(None, whole(5), False).float().var(0).max() == 0
    assert chosen(Scattered(seed=0)) != chosen(Scattered(seed=1))

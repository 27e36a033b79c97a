import pytest
from scipy.stats import binomtest

from ugr_lightning.errors import ConfigError
from ugr_lightning.results.power import mcnemar_power, paired_episodes, plan, unpaired_episodes


def test_episodes_of_90_against_95_percent():
    assert unpaired_episodes(0.90, 0.95) == 435  # Fleiss' table without correction
    assert unpaired_episodes(0.95, 0.90) == 435


def test_unpaired_episodes_reach_the_power_that_statsmodels_computes():
    reference = pytest.importorskip("statsmodels.stats.proportion").power_proportions_2indep
    for a, b in ((0.9, 0.95), (0.3, 0.4), (0.45, 0.5), (0.05, 0.5)):
        n = unpaired_episodes(a, b)
        reached, before = (reference(b - a, a, m, return_results=False) for m in (n, n - 1))
        assert before < 0.8 <= reached


def test_the_power_of_mcnemars_test_is_the_share_of_rejections():
    n, only_a, only_b = 30, 0.35, 0.1
    exact = 0.0
    from scipy.stats import multinomial

    for a in range(n + 1):
        for b in range(n + 1 - a):
            if a + b and binomtest(a, a + b, 0.5).pvalue <= 0.05:
                exact += multinomial.pmf([a, b, n - a - b], n, [only_a, only_b, 1 - only_a - only_b])
    assert mcnemar_power(n, only_a, only_b) == pytest.approx(exact, abs=1e-12)


def test_paired_episodes_reach_the_power_and_one_fewer_does_not():
    n = paired_episodes(0.05, 0.14)
    assert mcnemar_power(n, 0.095, 0.045) >= 0.8 > mcnemar_power(n - 1, 0.095, 0.045)


def test_sharing_seeds_saves_episodes_when_the_policies_fail_on_the_same_ones():
    assert plan(0.9, 0.95, discordance=0.05).paired < plan(0.9, 0.95, discordance=0.09).paired < 435
    assert plan(0.9, 0.95).discordance == pytest.approx(0.14)


@pytest.mark.parametrize(
    ("rates", "options", "message"),
    [
        ((0.5, 0.5), {}, "different"),
        ((0.5, 1.5), {}, "between 0 and 1"),
        ((0.9, 0.95), {"discordance": 0.01}, "discordance"),
        ((0.9, 0.95), {"discordance": 0.3}, "discordance"),
        ((0.9, 0.9 + 1e-6), {}, "at most"),
    ],
)
def test_impossible_questions_are_explained(rates, options, message):
    with pytest.raises(ConfigError, match=message):
        plan(*rates, **options)

"""Tests and intervals over several comparisons at once: Holm, sign flips, hierarchical bootstrap."""

from collections.abc import Sequence

import numpy as np

RESAMPLES = 10_000
"""How often seeds are drawn."""


def holm(p_values: Sequence[float]) -> list[float]:
    """p-values corrected for their number, so that any error among all of them has the stated probability.

    Args:
        p_values: of the tests of one family.

    Returns:
        Adjusted p-values in the same order.

    Source: Holm (1979), "A simple sequentially rejective multiple test procedure".
    """
    adjusted, largest = [0.0] * len(p_values), 0.0
    for rank, index in enumerate(sorted(range(len(p_values)), key=p_values.__getitem__)):
        largest = max(largest, min(1.0, (len(p_values) - rank) * p_values[index]))
        adjusted[index] = largest
    return adjusted


def sign_flip_test(differences: Sequence[int]) -> float:
    """Exact two-sided p-value that independent differences are symmetric around zero.

    With differences of -1, 0 and 1, which single episodes give, it is the exact McNemar test. An evaluation seed that
    was tried with several training seeds counts once here, with the sum over them: its episodes are no independent
    trials.

    Args:
        differences: successes of a minus successes of b, one number per evaluation seed.

    Returns:
        Share of the sign patterns whose sum is at least as far from zero; computed without sampling.

    Source: Fisher (1935); Good (2005), "Permutation, Parametric and Bootstrap Tests of Hypotheses".
    """
    sizes = [abs(int(difference)) for difference in differences if difference]
    if not sizes:
        return 1.0
    total, observed = sum(sizes), abs(sum(int(difference) for difference in differences))
    chance = np.zeros(2 * total + 1)  # of every sum from -total to total
    chance[total] = 1.0
    for size in sizes:
        chance = (np.roll(chance, size) + np.roll(chance, -size)) / 2  # cannot wrap: sums stay within +-total
    sums = np.abs(np.arange(-total, total + 1))
    return min(1.0, float(chance[sums >= observed].sum()))


def hierarchical_bootstrap(a: Sequence[np.ndarray], b: Sequence[np.ndarray], *, seed: int = 0) -> tuple[float, float]:
    """Interval of a difference of success rates, for other training seeds and other evaluation seeds.

    Draws training seeds of either policy, and evaluation seeds common to both, with replacement. Tasks stay as they
    are: nothing is said about other tasks. With one training seed the interval covers the evaluation seeds only.

    Args:
        a: per task, outcomes (training seeds, evaluation seeds) of one policy, 0 or 1.
        b: the same of the other; its columns are the same evaluation seeds.
        seed: of the draws.

    Returns:
        Limits of the 95 % percentile interval of the mean rate of a minus that of b, tasks weighing the same.

    Raises:
        ValueError: the tasks or the evaluation seeds of a and b do not match.

    Source: Davison and Hinkley (1997), "Bootstrap Methods and their Application", section 3.8.
    """
    if (
        not a
        or len(a) != len(b)
        or any(x.shape[1] != y.shape[1] or 0 in (*x.shape, *y.shape) for x, y in zip(a, b, strict=True))
    ):
        raise ValueError(f"outcomes of {[x.shape for x in a]} against {[y.shape for y in b]}")
    rng = np.random.default_rng(seed)
    drawn = np.zeros(RESAMPLES)
    for x, y in zip(a, b, strict=True):
        columns = _weights(rng, x.shape[1])  # (RESAMPLES, evaluation seeds)
        for outcomes, sign in ((x, 1.0), (y, -1.0)):
            rows = _weights(rng, outcomes.shape[0])  # (RESAMPLES, training seeds)
            drawn += sign * np.einsum("ir,rn,in->i", rows, outcomes.astype(float), columns, optimize=True) / len(a)
    low, high = np.quantile(drawn, [0.025, 0.975])
    return float(low), float(high)


def _weights(rng: np.random.Generator, n: int) -> np.ndarray:
    """How often each of n items occurs in a draw of n with replacement, as shares, (RESAMPLES, n)."""
    return rng.multinomial(n, np.full(n, 1 / n), size=RESAMPLES) / n

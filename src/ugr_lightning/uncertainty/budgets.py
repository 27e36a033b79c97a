"""One checkpoint, many budgets: the error after refining more or fewer steps, chosen by s_k and by its rivals."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch

from ugr_lightning.contract import ChunkPolicy
from ugr_lightning.models.refine.budget import with_refine_ratio
from ugr_lightning.models.refine.head import Head
from ugr_lightning.models.refine.ranked import Ranked
from ugr_lightning.models.refine.scattered import Scattered
from ugr_lightning.models.refine.tail import Tail
from ugr_lightning.models.refine.uncertainty import Uncertainty
from ugr_lightning.results.tables import Cells
from ugr_lightning.uncertainty.calibration import Interval, bootstrap, position_mean
from ugr_lightning.uncertainty.predictions import Predictions

RATIOS = tuple(round(0.1 * tenth, 1) for tenth in range(11))


class Sweep(NamedTuple):
    """Mean error of the executed actions by budget and selector, on the validation episodes.

    Args:
        ratios: shares of the chunk that are refined, 0 to 1.
        error: by selector, an interval for each ratio.
        against_coarse: by selector, the same minus the error of the coarse actions, as intervals.
    """

    ratios: tuple[float, ...]
    error: dict[str, list[Interval]]
    against_coarse: dict[str, list[Interval]]


def selectors(ratio: float, prior: np.ndarray, everything: Predictions) -> dict[str, tuple[Ranked, np.ndarray]]:
    """Each rule with the scores it is given; `oracle` and `gain` are given what nobody knows at run time.

    Args:
        ratio: share of the chunk.
        prior: (K,) mean error by position on the training episodes.
        everything: predictions with all steps refined.
    """
    learned, highest = everything.log_variance, Uncertainty(ratio)
    assert learned is not None
    return {
        "learned": (highest, learned),
        "prior": (highest, np.broadcast_to(prior, learned.shape)),
        "scattered": (Scattered(ratio), learned),
        "head": (Head(ratio), learned),
        "tail": (Tail(ratio), learned),
        "oracle": (highest, everything.coarse),
        "gain": (highest, everything.coarse - everything.executed),
    }


def refined_error(everything: Predictions, selector: Ranked, score: np.ndarray) -> np.ndarray:
    """Error (n, K) of the executed actions when a selector decides which steps are refined.

    Exact: a correction does not depend on which other steps are corrected.

    Args:
        everything: predictions with all steps refined.
        selector: the rule.
        score: (n, K) what it is given in the place of the log-variance.
    """
    known = ~np.isnan(everything.coarse)
    chosen = selector.select(torch.from_numpy(np.where(known, score, 0.0)), torch.from_numpy(known), False).numpy()
    return np.where(chosen, everything.executed, everything.coarse)


def sweep(
    everything: Predictions, training_error: np.ndarray, ratios: tuple[float, ...] = RATIOS, resamples: int = 500
) -> Sweep:
    """Error for each budget and selector.

    Args:
        everything: predictions on the validation episodes with all steps refined.
        training_error: (n', K) coarse error on the training episodes, for the prior.
        ratios: budgets; 0 refines nothing.
        resamples: draws of the bootstrap over episodes.
    """
    prior, steps = position_mean(training_error), everything.coarse.shape[1]
    names, errors = list(selectors(1.0, prior, everything)), list[np.ndarray]()
    for ratio in ratios:
        if ratio * steps + 1e-9 < 1:
            errors += [everything.coarse] * len(names)
        else:
            errors += [refined_error(everything, *rule) for rule in selectors(ratio, prior, everything).values()]
    found = _beside_coarse(errors, everything, resamples)
    by_name = {name: found[i :: len(names)] for i, name in enumerate(names)}
    error = {name: [one.error for one in of] for name, of in by_name.items()}
    return Sweep(tuple(ratios), error, {name: [one.against_coarse for one in of] for name, of in by_name.items()})


class BudgetError(NamedTuple):
    """Mean error of the executed actions with one budget, and the same minus that of the coarse actions."""

    error: Interval
    against_coarse: Interval

    def signed(self) -> str:
        """The difference as a cell."""
        return _signed(self.against_coarse)


def budget_errors(policy: ChunkPolicy, everything: Predictions, ratios: Sequence[float]) -> list[BudgetError]:
    """Error on the validation episodes when the policy's own selector spends each budget.

    Args:
        policy: one that ranks steps.
        everything: its predictions with all steps refined.
        ratios: shares of the chunk; what rounds down to no step refines none.
    """
    score = np.zeros(everything.coarse.shape) if everything.log_variance is None else everything.log_variance
    errors = []
    for ratio in ratios:
        selector: Any = getattr(with_refine_ratio(policy, ratio), "refine", None)
        errors.append(everything.coarse if selector is None else refined_error(everything, selector, score))
    return _beside_coarse(errors, everything)


def _beside_coarse(errors: Sequence[np.ndarray], everything: Predictions, resamples: int = 500) -> list[BudgetError]:
    """The mean of each (n, K) error, and of what it is above that of the coarse actions, with intervals."""
    sums = np.stack([np.nansum(error, axis=1) for error in (*errors, everything.coarse)])  # (errors + 1, n)
    counts = (~np.isnan(everything.coarse)).sum(1)  # (n,)

    def means(rows: np.ndarray) -> np.ndarray:
        of = sums[:, rows].sum(1) / counts[rows].sum()  # (errors + 1,)
        return np.concatenate([of[:-1], of[:-1] - of[-1]])

    found = bootstrap(means, everything.episode, resamples)
    return [BudgetError(*pair) for pair in zip(found[: len(errors)], found[len(errors) :], strict=True)]


def sweep_table(found: Sweep) -> Cells:
    """Error by budget and selector as cells, heading first."""
    cells: Cells = [("refined", *found.error, "s_k - coarse")]
    for i, ratio in enumerate(found.ratios):
        errors = [f"{intervals[i].value:.4f}" for intervals in found.error.values()]
        cells.append((f"{ratio:.0%}", *errors, _signed(found.against_coarse["learned"][i])))
    return cells


def _signed(interval: Interval) -> str:
    return f"{interval.value:+.4f} [{interval.low:+.4f}, {interval.high:+.4f}]"


def sweep_figure(found: Sweep) -> Any:
    """Error over the budget, one line per selector.

    Args:
        found: what `sweep` returned.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axis = figure.subplots()
    for name, intervals in found.error.items():
        label = {"learned": "s_k", "oracle": "oracle: largest error", "gain": "oracle: largest gain"}.get(name, name)
        axis.plot(found.ratios, [one.value for one in intervals], marker=".", label=label)
    axis.set(xlabel="share of the chunk that is refined", ylabel="mean error (standard deviations)")
    axis.legend(fontsize=8)
    return figure

"""Figures of `ugr analyze`, for files and for TensorBoard."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure

COLOURS = {
    "learned": "tab:orange",
    "prior": "tab:blue",
    "position": "tab:blue",
    "oracle": "black",
    "constant": "tab:gray",
}
NAMES = {"learned": "s_k", "prior": "position prior", "position": "position only", "oracle": "oracle (true error)"}


def calibration_figure(found: dict[str, Any]) -> Figure:
    """Error by position, sparsification, coverage, and error by predicted deviation.

    Args:
        found: what `calibration_report.curves` returned.
    """
    figure = Figure(figsize=(10, 7), layout="constrained")
    (by_position, sparse), (covered, reliable) = figure.subplots(2, 2)
    _by_position(by_position, found["position"])
    curve = found["sparsification"]
    for name in ("learned", "prior", "oracle"):
        sparse.plot(curve["fractions"], curve[name], color=COLOURS[name], label=NAMES[name])
    sparse.axhline(1, color="tab:gray", lw=1, ls=":")
    sparse.set(xlabel="share of steps left out, most uncertain first", ylabel="mean error of the rest / of all")
    sparse.set_ylim(bottom=0)
    sparse.legend(fontsize=8)
    of = found["coverage"]
    for name in ("learned", "position", "constant"):
        covered.plot(of["levels"], of[name], color=COLOURS[name], marker="o", label=NAMES.get(name, name))
    covered.plot([0, 1], [0, 1], color="black", lw=1, ls=":")
    covered.set(xlabel="nominal coverage", ylabel="share of errors covered", xlim=(0, 1), ylim=(0, 1))
    covered.legend(fontsize=8)
    ten = found["reliability"]
    reliable.plot(ten["deviation"], ten["error"], color=COLOURS["learned"], marker="o")
    reliable.axline((0, 0), slope=1, color="black", lw=1, ls=":")
    reliable.set(xlabel="predicted deviation exp(s/2), by tenths of the steps", ylabel="RMS error")
    reliable.set(xlim=(0, 1.1 * ten["deviation"].max()), ylim=(0, 1.1 * ten["error"].max()))
    return figure


def _by_position(axis: Any, of: dict[str, np.ndarray]) -> None:
    axis.plot(of["error"], color="black", label="error, validation")
    axis.plot(of["training_error"], color=COLOURS["prior"], label="error, training: the prior")
    axis.plot(of["deviation"], color=COLOURS["learned"], ls="--", label="predicted deviation exp(s/2)")
    axis.set(xlabel="position k in the chunk", ylabel="standard deviations")
    axis.set_ylim(0, 1.4 * max(of["error"].max(), of["deviation"].max()))  # room for the legend
    other = axis.twinx()
    other.bar(range(len(of["refined"])), of["refined"], color="tab:gray", alpha=0.25, label="refined, share")
    other.set_ylim(0, 1)
    axis.legend(fontsize=8, loc="upper left")


def event_figure(events: dict[str, dict[str, Any]]) -> Figure:
    """Error and predicted deviation around events, relative to the mean of their position in the chunk.

    Args:
        events: what `calibration_report.around_events` returned, at least one kind.
    """
    figure = Figure(figsize=(4 * len(events), 3.5), layout="constrained")
    axes = figure.subplots(1, len(events), squeeze=False, sharey=True)[0]
    for axis, (kind, of) in zip(axes, events.items(), strict=True):
        axis.plot(of["lag"], of["relative_error"], color="black", label="error")
        axis.plot(of["lag"], of["relative_deviation"], color=COLOURS["learned"], ls="--", label="predicted deviation")
        axis.axvline(0, color="tab:red", lw=1)
        axis.axhline(1, color="tab:gray", lw=1, ls=":")
        axis.set(title=f"{kind} (n = {of['count']})", xlabel="control steps after the event")
    axes[0].set_ylabel("relative to the mean of the position")
    axes[0].set_ylim(bottom=0)
    axes[0].legend(fontsize=8)
    return figure

"""Whether a policy's uncertainty knows its error: predictions along demonstrations, calibration, budgets, events.

Imported when it is first used, as everything in `ugr_lightning`.
"""

from typing import Any

from ugr_lightning.system.lazy import lazily

_HOMES = {
    "budgets": ("sweep", "sweep_figure", "sweep_table"),
    "calibration_figures": ("calibration_figure", "event_figure"),
    "calibration_report": (
        "around_events",
        "calibration_verdict",
        "compare_with_prior",
        "coverage_table",
        "curves",
        "event_table",
        "generalisation",
        "generalisation_table",
        "table",
    ),
    "events": ("find_events",),
    "predictions": ("open_data", "predict"),
    "study": ("as_markdown",),
}
__all__ = [name for names in _HOMES.values() for name in names]


def __getattr__(name: str) -> Any:
    return lazily(__name__, _HOMES, name)

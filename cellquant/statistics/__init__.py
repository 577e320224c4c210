"""Statistics over independent experiments: trends, comparisons, and values known as bounds.

The unit of replication is the trial, never the frame or the cell.
"""

from cellquant.statistics.censored import fit_censored_model
from cellquant.statistics.comparisons import holm, log_rank, mann_whitney, mean_over_trials
from cellquant.statistics.mixed import MixedModel, fit_mixed_model
from cellquant.statistics.study import (
    compare_conditions,
    means_by_bin,
    study_statistics,
    tau_alpha_trend,
)

__all__ = [
    "MixedModel",
    "compare_conditions",
    "fit_censored_model",
    "fit_mixed_model",
    "holm",
    "log_rank",
    "mann_whitney",
    "mean_over_trials",
    "means_by_bin",
    "study_statistics",
    "tau_alpha_trend",
]

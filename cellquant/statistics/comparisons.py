"""Comparisons between groups and means over trials; values may be known only as bounds."""

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats

FloatArray = np.ndarray[Any, np.dtype[np.float64]]


def mann_whitney(groups: Mapping[str, Sequence[float] | FloatArray]) -> pd.DataFrame:
    """Mann-Whitney U test of every pair of groups, with effect size and Holm's correction.

    Parameters
    ----------
    groups
        Values of each group; one per independent trial where P is to mean anything. NaN is
        left out.

    Returns
    -------
    pandas.DataFrame
        first, second, n_first, n_second, u, superiority (probability that a value of the first
        exceeds one of the second, ties counting half), rank_biserial (2 superiority - 1),
        p_value (two-sided; exact without ties up to eight values, else normal with tie
        correction), p_holm, smallest_p (the least P these sample sizes allow), reason.

    References
    ----------
    Mann & Whitney, Ann. Math. Stat. 18, 50 (1947), doi:10.1214/aoms/1177730491.
    Holm, Scand. J. Stat. 6, 65 (1979).
    """
    rows = []
    for first, second in combinations(groups, 2):
        a, b = (np.asarray(groups[name], dtype=np.float64) for name in (first, second))
        a, b = a[np.isfinite(a)], b[np.isfinite(b)]
        row: dict[str, Any] = {
            "first": first, "second": second, "n_first": a.size, "n_second": b.size,
            "u": np.nan, "superiority": np.nan, "rank_biserial": np.nan, "p_value": np.nan,
            "p_holm": np.nan, "smallest_p": np.nan, "reason": None,
        }  # fmt: skip
        if min(a.size, b.size) == 0:
            row["reason"] = f"{first if a.size == 0 else second} has no value"
        else:
            u = float(np.sum(a[:, None] > b[None]) + 0.5 * np.sum(a[:, None] == b[None]))
            pooled = np.concatenate([a, b])
            if np.ptp(pooled) == 0:
                row["p_value"], row["reason"] = 1.0, "all values are equal"
            else:
                row["p_value"] = float(stats.mannwhitneyu(a, b, alternative="two-sided").pvalue)
            row.update(u=u, superiority=u / (a.size * b.size))
            row["rank_biserial"] = 2 * row["superiority"] - 1
            row["smallest_p"] = min(1.0, 2 / float(_choose(a.size + b.size, a.size)))
        rows.append(row)
    table = pd.DataFrame(rows)
    if len(table):
        table["p_holm"] = holm(table["p_value"].to_numpy())
    return table


def _choose(n: int, k: int) -> float:
    return float(np.exp(np.sum(np.log(np.arange(n - k + 1, n + 1)) - np.log(np.arange(1, k + 1)))))


def holm(p_values: FloatArray) -> FloatArray:
    """Holm's step-down adjustment; NaN stays NaN and does not count as a test."""
    adjusted = np.full(p_values.size, np.nan)
    known = np.flatnonzero(np.isfinite(p_values))
    order = known[np.argsort(p_values[known], kind="stable")]
    factor = np.arange(known.size, 0, -1)
    adjusted[order] = np.minimum(np.maximum.accumulate(p_values[order] * factor), 1.0)
    return adjusted


def log_rank(
    first: FloatArray, second: FloatArray, *, first_censored: Any, second_censored: Any
) -> float:
    """Probability that two sets of relaxation times are alike, some known only to be longer.

    Parameters
    ----------
    first, second
        Values, or the bounds that censored ones exceed.
    first_censored, second_censored
        Which of them are bounds.

    Returns
    -------
    float
        Two-sided P of the log-rank test (normal approximation); NaN when a set is empty or
        everything is censored.

    References
    ----------
    Mantel, Cancer Chemother. Rep. 50, 163 (1966).
    """
    samples = []
    for values, censored in ((first, first_censored), (second, second_censored)):
        bound = np.asarray(censored, dtype=bool)
        samples.append((np.asarray(values, np.float64)[~bound], np.asarray(values)[bound]))
    if any(a.size + b.size == 0 for a, b in samples) or sum(a.size for a, _ in samples) < 2:
        return float("nan")
    data = [stats.CensoredData(uncensored=a, right=b) for a, b in samples]
    return float(stats.logrank(*data).pvalue)


def mean_over_trials(values: Sequence[float] | FloatArray) -> dict[str, Any]:
    """Mean and standard error over independent trials; NaN is left out.

    Returns
    -------
    dict
        mean, std_error, n; the error is None with one trial, both with none, with a reason.
    """
    known = np.asarray(values, dtype=np.float64)
    known = known[np.isfinite(known)]
    if known.size == 0:
        return {"mean": None, "std_error": None, "n": 0, "reason": "no trial has a value"}
    if known.size == 1:
        reason = "one trial, so no error can be estimated"
        return {"mean": float(known[0]), "std_error": None, "n": 1, "reason": reason}
    error = float(known.std(ddof=1) / np.sqrt(known.size))
    return {"mean": float(known.mean()), "std_error": error, "n": int(known.size)}

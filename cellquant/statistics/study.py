"""Statistics of a whole study: trends with density, differences between conditions."""

from typing import Any

import numpy as np
import pandas as pd

from cellquant.statistics.censored import fit_censored_model
from cellquant.statistics.comparisons import holm, log_rank, mann_whitney, mean_over_trials
from cellquant.statistics.mixed import fit_mixed_model

CENSORING_RULE = (
    "a tau_alpha that is only known to exceed the longest lag, or to be below the shortest, enters "
    "the mixed model as that: with the probability to lie beyond its bound (Tobit). Beside it "
    "stand the fits without such points (without_bounds) and with each at its bound (at_bound). "
    "Means over bins that hold such values are given as bounds, and their number is stated"
)


CENSORED_METHOD = (
    "restricted likelihood with bounds as bounds (Tobit), random effects integrated out"
)


def tau_alpha_trend(relaxation_times: pd.DataFrame) -> dict[str, Any]:
    """Mixed model of tau_alpha against density, per condition.

    Parameters
    ----------
    relaxation_times
        Columns condition, trial, density, tau_alpha, censored_at, below: one row per trial and
        density bin, as ``relaxation_times.parquet`` of `observe`, of all trials together.

    Returns
    -------
    dict
        Per condition the fields of `MixedModel`, method, n_censored, n_below. Where there are
        bounds the model is that of `fit_censored_model`, and ``without_bounds`` and ``at_bound``
        hold slope, std_error, p_value and interval_95 of the fits without them and with each
        taken as a value. Where that model has no answer the fit without bounds stands in its
        place and ``bounds_reason`` says why.
    """
    found = {}
    for condition, rows in _conditions(relaxation_times):
        value = rows["tau_alpha"].to_numpy(dtype=np.float64)
        bound = _bounds(rows)
        bounded = ~np.isfinite(value) & np.isfinite(bound)
        density, trial = rows["density"].to_numpy(dtype=np.float64), rows["trial"].to_numpy(str)
        plain = fit_mixed_model(density, value, trial)
        entry = {**plain.as_dict(), "method": "restricted maximum likelihood"}
        if bounded.any():
            lower, upper = (rows[k].to_numpy(dtype=np.float64) for k in ("censored_at", "below"))
            censored = fit_censored_model(density, value, trial, lower=lower, upper=upper)
            if censored.reason is None:
                entry = {**censored.as_dict(), "method": CENSORED_METHOD}
            else:
                entry["bounds_reason"] = censored.reason
            at_bound = fit_mixed_model(density, np.where(bounded, bound, value), trial)
            for name, fit in (("without_bounds", plain), ("at_bound", at_bound)):
                entry[name] = {
                    "slope": fit.slope, "std_error": fit.std_error, "p_value": fit.p_value,
                    "interval_95": fit.interval_95, "n": fit.n,
                }  # fmt: skip
        entry["n_censored"] = int(np.isfinite(rows["censored_at"].to_numpy(np.float64)).sum())
        entry["n_below"] = int(np.isfinite(rows["below"].to_numpy(np.float64)).sum())
        found[condition] = entry
    return found


def _conditions(table: pd.DataFrame) -> list[tuple[str, pd.DataFrame]]:
    names = table["condition"].fillna("all").astype(str)
    trials = table["trial"].fillna("1").astype(str)
    table = table.assign(condition=names, trial=trials)
    return [(name, table[names == name]) for name in dict.fromkeys(names)]


def _bounds(rows: pd.DataFrame) -> Any:
    upper = rows["below"].to_numpy(dtype=np.float64)
    lower = rows["censored_at"].to_numpy(dtype=np.float64)
    return np.where(np.isfinite(lower), lower, upper)


def means_by_bin(relaxation_times: pd.DataFrame) -> pd.DataFrame:
    """Mean tau_alpha and its standard error over trials, per condition and density bin.

    Parameters
    ----------
    relaxation_times
        See `tau_alpha_trend`; bin_centre too.

    Returns
    -------
    pandas.DataFrame
        condition, bin_centre, mean, std_error, n, n_censored, n_below, lower_bound. With a
        censored trial the mean is NaN and lower_bound is the mean with it at its bound.
    """
    rows = []
    for condition, part in _conditions(relaxation_times):
        for centre, inside in part.groupby("bin_centre", sort=True):
            value = inside["tau_alpha"].to_numpy(dtype=np.float64)
            # Several stacks of one trial are one experiment.
            lower = inside["censored_at"].to_numpy(dtype=np.float64)
            below = inside["below"].to_numpy(dtype=np.float64)
            trial = inside["trial"].to_numpy(str)
            n_censored, n_below = int(np.isfinite(lower).sum()), int(np.isfinite(below).sum())
            per_trial = pd.Series(value).groupby(trial).mean().to_numpy()
            mean = mean_over_trials(per_trial)
            at_bound = pd.Series(np.where(np.isfinite(lower), lower, value)).groupby(trial).mean()
            whole = n_censored + n_below == 0
            rows.append(
                {
                    "condition": condition,
                    "bin_centre": centre,
                    "mean": mean["mean"] if whole else np.nan,
                    "std_error": mean["std_error"] if whole else np.nan,
                    "n": mean["n"],
                    "n_censored": n_censored,
                    "n_below": n_below,
                    "lower_bound": float(at_bound.mean()) if n_below == 0 else np.nan,
                }
            )
    columns = ["condition", "bin_centre", "mean", "std_error", "n", "n_censored", "n_below",
               "lower_bound"]  # fmt: skip
    table = pd.DataFrame(rows, columns=columns)
    kinds = dict.fromkeys(("bin_centre", "mean", "std_error", "lower_bound"), "float64")
    return table.astype(kinds)


def compare_conditions(trial_values: pd.DataFrame) -> list[dict[str, Any]]:
    """Mann-Whitney tests of every quantity between every pair of conditions.

    Parameters
    ----------
    trial_values
        Columns condition, trial, quantity, value: one row per trial and quantity; optionally
        censored, where the value is a bound that the true one exceeds.

    Returns
    -------
    list of dict
        The columns of `mann_whitney` with quantity. Where values are censored the ranks are not
        known: P is then that of the log-rank test, ``test`` says so and n_censored counts them.
        Holm's correction is over the pairs of one quantity, whichever test they took.
    """
    found: list[dict[str, Any]] = []
    for quantity, rows in trial_values.groupby("quantity", sort=False):
        censored = (
            rows["censored"].to_numpy(bool) if "censored" in rows else np.zeros(len(rows), bool)
        )
        names = rows["condition"].astype(str).to_numpy()
        value = rows["value"].to_numpy(dtype=np.float64)
        groups = {name: value[names == name] for name in dict.fromkeys(names)}
        bounds = {name: censored[names == name] for name in groups}
        tests: list[dict[str, Any]] = []
        for record in mann_whitney(groups).to_dict("records"):
            row: dict[str, Any] = {str(key): item for key, item in record.items()}
            pair = row["first"], row["second"]
            n_censored = int(sum(bounds[name].sum() for name in pair))
            row.update(quantity=quantity, test="Mann-Whitney", n_censored=n_censored)
            if n_censored:
                row.update(_log_rank_test([groups[k] for k in pair], [bounds[k] for k in pair]))
            tests.append(row)
        # Holm's rule holds for any tests, so the pairs of a quantity are one family.
        adjusted = holm(np.array([row["p_value"] for row in tests], dtype=np.float64))
        for row, p_holm in zip(tests, adjusted.tolist(), strict=True):
            row["p_holm"] = p_holm
        found += tests
    return found


def _log_rank_test(values: list[Any], bounds: list[Any]) -> dict[str, Any]:
    """What the log-rank test of two conditions puts in the place of Mann-Whitney's."""
    keep = [np.isfinite(v) for v in values]
    p_value = log_rank(
        *(v[k] for v, k in zip(values, keep, strict=True)),
        first_censored=bounds[0][keep[0]],
        second_censored=bounds[1][keep[1]],
    )
    reason = "ranks are not known where values are bounds"
    if not np.isfinite(p_value):
        reason = "fewer than two values are known, the others are bounds"
    return {
        "test": "log-rank", "p_value": p_value, "u": None, "superiority": None,
        "rank_biserial": None, "smallest_p": None, "reason": reason,
    }  # fmt: skip


def study_statistics(
    relaxation_times: pd.DataFrame,
    trial_values: pd.DataFrame | None = None,
    *,
    why_empty: str | None = None,
) -> dict[str, Any]:
    """Content of ``statistics.json``.

    Parameters
    ----------
    relaxation_times
        See `tau_alpha_trend`.
    trial_values
        See `compare_conditions`; None when there is nothing to compare.
    why_empty
        Why relaxation_times has no row, where that is known.

    Returns
    -------
    dict
        mixed_model (per condition), tau_alpha_by_bin, mann_whitney, censoring (the rule). What is
        empty has its reason beside it: mixed_model_reason, tau_alpha_by_bin_reason,
        mann_whitney_reason. JSON-ready: None instead of NaN.
    """
    tests = [] if trial_values is None else compare_conditions(trial_values)
    means = means_by_bin(relaxation_times)
    found: dict[str, Any] = {
        "mixed_model": _plain(tau_alpha_trend(relaxation_times)),
        "tau_alpha_by_bin": _plain(means.to_dict("records")),
        "mann_whitney": _plain(tests),
    }
    if not len(relaxation_times):
        why_empty = why_empty or "no window of any stack has a density inside a bin"
        found["mixed_model_reason"] = found["tau_alpha_by_bin_reason"] = why_empty
    elif not len(means):
        found["tau_alpha_by_bin_reason"] = "no density lies in a bin"
    if not tests:
        found["mann_whitney_reason"] = "there is one condition, and nothing to compare it with"
    return {**found, "censoring": CENSORING_RULE}


def _plain(value: Any) -> Any:
    """Python types only; NaN and infinity become None."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value

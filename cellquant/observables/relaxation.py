"""Structural relaxation time, with the cases in which there is none to report."""

from dataclasses import dataclass

import numpy as np

from cellquant.observables.blocks import leave_one_out
from cellquant.observables.dynamics import LagAverage
from cellquant.observables.trajectories import FloatArray

THRESHOLD = float(np.exp(-1.0))


@dataclass(frozen=True)
class RelaxationTime:
    """Result of `relaxation_time`.

    Attributes
    ----------
    value
        tau_alpha in time units; None where F_s does not cross the threshold.
    std_error
        Half the central 68 % range over bootstrap resamples of blocks; None where not measurable.
    interval
        Central 95 % range over resamples; an end is None where it is censored or unknown.
    censored_at
        Longest lag measured, where F_s stays above the threshold up to it: tau_alpha is larger.
    below
        Shortest lag measured, where F_s is below the threshold already: tau_alpha is smaller.
    censored_fraction
        Share of resamples that do not cross.
    reason
        Why a value or an error is missing; None when nothing is.
    bias
        By how much the value is expected to be too long, as the jackknife over blocks tells: the
        crossing is a convex function of a noisy curve. Not taken off. None where a curve without
        one of the blocks does not cross.
    """

    value: float | None
    std_error: float | None
    interval: tuple[float | None, float | None]
    censored_at: float | None
    below: float | None
    censored_fraction: float
    reason: str | None
    bias: float | None = None


def crossing_time(lag_time: FloatArray, value: FloatArray, threshold: float = THRESHOLD) -> float:
    """First time at which a decaying curve falls to the threshold.

    Between the two lags that bracket the crossing, ``ln(-ln F)`` is interpolated linearly in
    ``ln t``, which is exact for every stretched exponential that starts at 1; where F <= 0 or
    F >= 1 at one of them, F itself is interpolated in ``ln t``.

    Parameters
    ----------
    lag_time
        (L,) increasing lags > 0.
    value
        (L,) the curve; NaN where not measured.
    threshold
        Level in (0, 1).

    Returns
    -------
    float
        The crossing time; ``+inf`` when the curve stays above the threshold, ``-inf`` when it
        starts below it, NaN when nothing was measured.
    """
    known = np.isfinite(value)
    time, curve = lag_time[known], value[known]
    if time.size == 0:
        return float("nan")
    below = np.flatnonzero(curve <= threshold)
    if below.size == 0:
        return float("inf")
    k = int(below[0])
    if curve[k] == threshold:
        return float(time[k])
    if k == 0:
        return float("-inf")
    high, low = float(curve[k - 1]), float(curve[k])
    if low > 0 and high < 1:
        a, b, level = (float(np.log(-np.log(f))) for f in (high, low, threshold))
    else:
        a, b, level = high, low, threshold
    share = (level - a) / (b - a)
    return float(np.exp(np.log(time[k - 1]) + share * np.log(time[k] / time[k - 1])))


def relaxation_time(
    average: LagAverage,
    *,
    threshold: float = THRESHOLD,
    n_resamples: int = 400,
    seed: int = 0,
) -> RelaxationTime:
    """tau_alpha, where the self-intermediate scattering function has fallen to 1/e.

    ``F_s(q, tau_alpha) = 1/e``, interpolated in log time (`crossing_time`). The error comes from
    resampling the replicate blocks with replacement, widened by ``sqrt(B/(B - 1))`` for the B
    blocks; a resample that does not cross counts as infinitely long.

    Parameters
    ----------
    average
        F_s by block.
    threshold
        Level of the crossing.
    n_resamples
        Bootstrap resamples.
    seed
        Seed of the resampling; equal seeds give equal errors.

    Returns
    -------
    RelaxationTime
        Without a value when F_s never crosses (``censored_at``), crosses before the first lag
        (``below``) or was not measured.
    """
    curve = average.value
    known = np.flatnonzero(np.isfinite(curve))
    if known.size == 0:
        reason = "no track has two points of the same trajectory"
        return RelaxationTime(None, None, (None, None), None, None, 0.0, reason)
    first, last = float(average.lag_time[known[0]]), float(average.lag_time[known[-1]])
    tau = crossing_time(average.lag_time, curve, threshold)
    resamples = _bootstrap(average, threshold, n_resamples, seed)
    censored = float(np.mean(np.isposinf(resamples))) if resamples.size else 0.0
    if np.isinf(tau):
        never = tau > 0
        reason = (
            f"F_s stays above {threshold:.4g} up to the longest lag (censored_at)"
            if never
            else f"F_s is below {threshold:.4g} at the shortest lag (below) already"
        )
        low = _quantile(resamples, 0.025) if never else None
        high = None if never else first
        return RelaxationTime(
            None, None, (low, high), last if never else None, None if never else first, censored,
            reason,
        )  # fmt: skip
    blocks = int(np.sum(average.counts.sum(axis=1) > 0))
    if blocks < 2:
        reason = "the error needs at least two replicate blocks"
        return RelaxationTime(tau, None, (None, None), None, None, 0.0, reason)
    widen = np.sqrt(blocks / (blocks - 1))
    low68, high68 = (_quantile(resamples, p) for p in (0.158655, 0.841345))
    low95, high95 = (_quantile(resamples, p) for p in (0.025, 0.975))
    interval = (
        None if low95 is None else max(tau - widen * (tau - low95), 0.0),
        None if high95 is None else tau + widen * (high95 - tau),
    )
    bias = _bias(average, threshold, tau)
    if low68 is None or high68 is None:
        reason = f"{censored:.0%} of the bootstrap resamples do not cross, so the error is open"
        return RelaxationTime(tau, None, interval, None, None, censored, reason, bias)
    error = float(widen * (high68 - low68) / 2)
    return RelaxationTime(tau, error, interval, None, None, censored, None, bias)


def _bias(average: LagAverage, threshold: float, tau: float) -> float | None:
    """(B - 1) (mean of the crossing times without each block - that with all)."""
    used = average.counts.sum(axis=1) > 0
    with np.errstate(divide="ignore", invalid="ignore"):
        curves = leave_one_out(average.sums[used]) / leave_one_out(average.counts[used])
    times = [crossing_time(average.lag_time, curve, threshold) for curve in curves]
    bias = (len(times) - 1) * (float(np.mean(times)) - tau)
    return bias if np.isfinite(bias) else None


def _bootstrap(average: LagAverage, threshold: float, n: int, seed: int) -> FloatArray:
    """Crossing times of resampled blocks; infinite where a resample does not cross."""
    used = average.counts.sum(axis=1) > 0
    sums, counts = average.sums[used], average.counts[used]
    n_blocks = int(used.sum())
    if n_blocks < 2:
        return np.empty(0)
    rng = np.random.default_rng(seed)
    weight = rng.multinomial(n_blocks, np.full(n_blocks, 1 / n_blocks), size=n).astype(float)
    with np.errstate(divide="ignore", invalid="ignore"):
        # Not a matrix product, whose last digits depend on the number of threads.
        curves = np.einsum("nb,bl->nl", weight, sums) / np.einsum("nb,bl->nl", weight, counts)
    times = np.array([crossing_time(average.lag_time, c, threshold) for c in curves])
    return np.sort(times[~np.isnan(times)])


def _quantile(ordered: FloatArray, p: float) -> float | None:
    """Order statistic at p; None where it is infinite, that is, censored."""
    if ordered.size == 0:
        return None
    value = float(ordered[min(int(p * ordered.size), ordered.size - 1)])
    return value if np.isfinite(value) else None

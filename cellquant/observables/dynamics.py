"""How far cells move in a time: displacements, scattering, overlap and their fluctuations."""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pandas as pd

from cellquant.observables import kernels
from cellquant.observables.blocks import (
    Blocks,
    jackknife_error,
    leave_one_out,
    ratio_with_error,
    spatial_blocks,
    sum_by_block,
)
from cellquant.observables.smoothing import from_tracks
from cellquant.observables.trajectories import FloatArray, IntArray, Trajectories, log_lags
from cellquant.tables import Tracks

ScatteringMethod = Literal["bessel", "vectors"]


@dataclass(frozen=True)
class LagAverage:
    """An average over pairs of points, kept by replicate block.

    Attributes
    ----------
    lag_time
        (L,) lags in time units.
    sums
        (n_blocks, L) sum of the averaged quantity in each block.
    counts
        (n_blocks, L) number of pairs in each block.
    method
        What the blocks are.
    """

    lag_time: FloatArray
    sums: FloatArray
    counts: FloatArray
    method: str

    @property
    def value(self) -> FloatArray:
        """(L,) the average, NaN where there is no pair."""
        return ratio_with_error(self.sums, self.counts)[0]

    def table(self) -> pd.DataFrame:
        """Tidy table with the columns lag_time, value, std_error, n_pairs."""
        value, error = ratio_with_error(self.sums, self.counts)
        return lag_table(self.lag_time, value, error, self.counts.sum(axis=0))


def pool(averages: list[LagAverage]) -> LagAverage:
    """Join averages over the same quantity; the blocks of all become the blocks of the whole.

    Lags that some of them lack count there as no data.
    """
    lag_time = np.unique(np.concatenate([a.lag_time for a in averages]))
    sums: list[FloatArray] = []
    counts: list[FloatArray] = []
    for average in averages:
        column = np.searchsorted(lag_time, average.lag_time)
        for source, target in ((average.sums, sums), (average.counts, counts)):
            wide = np.zeros((source.shape[0], lag_time.size))
            wide[:, column] = source
            target.append(wide)
    method = f"jackknife over the spatial blocks of {len(averages)} windows"
    return LagAverage(lag_time, np.vstack(sums), np.vstack(counts), method)


def lag_table(
    lag_time: FloatArray, value: FloatArray, error: FloatArray, n_pairs: Any
) -> pd.DataFrame:
    """Assemble the tidy table of an observable against lag."""
    return pd.DataFrame(
        {
            "lag_time": lag_time,
            "value": value,
            "std_error": error,
            "n_pairs": np.rint(n_pairs).astype(np.int64),
        }
    )


def as_trajectories(source: Tracks | Trajectories) -> Trajectories:
    """Return the array layout of tracks, or the trajectories themselves."""
    return source if isinstance(source, Trajectories) else from_tracks(source)


def _prepare(
    source: Tracks | Trajectories, lags: IntArray | None, stride: int
) -> tuple[Trajectories, IntArray, Blocks]:
    paths = as_trajectories(source)
    if stride < 1:
        raise ValueError(f"stride must be >= 1 frame between time origins, got {stride}")
    chosen = log_lags(paths.max_lag) if lags is None else np.asarray(lags, dtype=np.int64)
    if chosen.size and (chosen.min() < 1 or (np.diff(chosen) <= 0).any()):
        raise ValueError(f"lags must be increasing frame numbers >= 1, got {chosen.tolist()}")
    return paths, chosen, spatial_blocks(paths.centre, box=paths.box)


def _lag_time(lags: IntArray, paths: Trajectories) -> FloatArray:
    return lags.astype(np.float64) * paths.frame_interval


def displacement_moments(
    source: Tracks | Trajectories, *, lags: IntArray | None = None, stride: int = 1
) -> tuple[LagAverage, LagAverage]:
    """Average the second and the fourth power of the displacement.

    Parameters
    ----------
    source
        Trajectories.
    lags
        Lags in frames, increasing; about 35 evenly spaced in the logarithm when None.
    stride
        Frames between time origins; 1 uses every origin.

    Returns
    -------
    second, fourth : LagAverage
        In length units to the power 2 and 4.
    """
    paths, chosen, blocks = _prepare(source, lags, stride)
    second, fourth = kernels.moments(paths, chosen, stride=stride)
    counts = sum_by_block(kernels.pair_counts(paths, chosen, stride=stride), blocks)
    time = _lag_time(chosen, paths)
    return (
        LagAverage(time, sum_by_block(second, blocks), counts, blocks.method),
        LagAverage(time, sum_by_block(fourth, blocks), counts, blocks.method),
    )


def mean_square_displacement(
    source: Tracks | Trajectories, *, lags: IntArray | None = None, stride: int = 1
) -> pd.DataFrame:
    """Mean-square displacement.

    ``MSD(t) = < |r_i(s + t) - r_i(s)|^2 >`` over all tracks i and time origins s at which both
    points exist.

    Parameters
    ----------
    source
        Trajectories.
    lags
        Lags in frames, increasing; about 35 evenly spaced in the logarithm when None.
    stride
        Frames between time origins; 1 uses every origin.

    Returns
    -------
    pandas.DataFrame
        lag_time, value (length squared), std_error (jackknife over blocks of tracks), n_pairs.
        Undefined (NaN) when no track has two points that far apart.
    """
    return displacement_moments(source, lags=lags, stride=stride)[0].table()


def non_gaussian_parameter(
    source: Tracks | Trajectories, *, lags: IntArray | None = None, stride: int = 1
) -> pd.DataFrame:
    """Non-Gaussian parameter in two dimensions.

    ``alpha_2(t) = <r^4> / (2 <r^2>^2) - 1``: 0 for Gaussian displacements.

    Parameters
    ----------
    source, lags, stride
        As in `mean_square_displacement`.

    Returns
    -------
    pandas.DataFrame
        lag_time, value, std_error, n_pairs. Undefined (NaN) when nothing moved.

    References
    ----------
    Rahman, Phys. Rev. 136, A405 (1964), doi:10.1103/PhysRev.136.A405, in its 2-D form.
    """
    return alpha2_table(*displacement_moments(source, lags=lags, stride=stride))


def alpha2_table(second: LagAverage, fourth: LagAverage) -> pd.DataFrame:
    """alpha_2 from moments, with the ratio's 1/n bias removed by the jackknife."""

    def ratio(s2: FloatArray, s4: FloatArray, n: FloatArray) -> FloatArray:
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(s2 > 0, s4 * n / (2 * s2**2) - 1, np.nan)

    counts = second.counts
    value = ratio(second.sums.sum(axis=0), fourth.sums.sum(axis=0), counts.sum(axis=0))
    replicates = ratio(*(leave_one_out(a) for a in (second.sums, fourth.sums, counts)))
    n = np.sum(counts > 0, axis=0)
    mean = np.where(counts > 0, replicates, 0.0).sum(axis=0) / np.maximum(n, 1)
    unbiased = np.where(n >= 2, n * value - (n - 1) * mean, value)
    error = jackknife_error(replicates, counts)
    return lag_table(second.lag_time, unbiased, error, counts.sum(axis=0))


def scattering_average(
    source: Tracks | Trajectories,
    q: float,
    *,
    lags: IntArray | None = None,
    method: ScatteringMethod = "bessel",
    n_vectors: int = 8,
    stride: int = 1,
) -> LagAverage:
    """Self-intermediate scattering function, kept by block: see `self_intermediate_scattering`."""
    if not q > 0 or not np.isfinite(q):
        raise ValueError(f"q must be a wave number > 0, got {q}")
    paths, chosen, blocks = _prepare(source, lags, stride)
    if method == "bessel":
        sums = kernels.scattering_bessel(paths, chosen, np.array([q]), stride=stride)[0]
    elif method == "vectors":
        if n_vectors < 2:
            raise ValueError(f"n_vectors must be >= 2 directions, got {n_vectors}")
        angle = np.pi * (np.arange(n_vectors) + 0.5) / n_vectors
        vectors = q * np.column_stack([np.cos(angle), np.sin(angle)])
        sums = kernels.scattering_vectors(paths, chosen, vectors, stride=stride).mean(axis=0)
    else:
        raise ValueError(f"method must be 'bessel' or 'vectors', got {method!r}")
    counts = sum_by_block(kernels.pair_counts(paths, chosen, stride=stride), blocks)
    time = _lag_time(chosen, paths)
    return LagAverage(time, sum_by_block(sums, blocks), counts, blocks.method)


def self_intermediate_scattering(
    source: Tracks | Trajectories,
    q: float,
    *,
    lags: IntArray | None = None,
    method: ScatteringMethod = "bessel",
    n_vectors: int = 8,
    stride: int = 1,
) -> pd.DataFrame:
    """Self-intermediate scattering function, isotropic average.

    ``F_s(q, t) = < J0(q |r_i(s + t) - r_i(s)|) >``: the average of ``cos(q . dr)`` over all
    directions of q, done exactly. With ``method="vectors"`` it is averaged over n_vectors
    directions instead, spread evenly over a half circle; for one displacement r the two differ
    by at most ``2 |J_m(q r)| + ...`` with ``m = 2 n_vectors``, less than 1e-4 for q r < 7 and
    eight vectors.

    Parameters
    ----------
    source
        Trajectories.
    q
        Wave number, > 0, in inverse length units.
    lags
        Lags in frames, increasing; about 35 evenly spaced in the logarithm when None.
    method
        "bessel" or "vectors".
    n_vectors
        Directions of the second method.
    stride
        Frames between time origins; 1 uses every origin.

    Returns
    -------
    pandas.DataFrame
        lag_time, value, std_error, n_pairs; NaN when no track has two points that far apart.

    Raises
    ------
    ValueError
        If q is not positive or the method is unknown.
    """
    return scattering_average(
        source, q, lags=lags, method=method, n_vectors=n_vectors, stride=stride
    ).table()


@dataclass(frozen=True)
class Overlap:
    """Overlap function and its fluctuation between time origins.

    Attributes
    ----------
    overlap, susceptibility
        Tables of Q(t) and chi_4(t): lag_time, value, std_error, n_pairs.
    """

    overlap: pd.DataFrame
    susceptibility: pd.DataFrame


def overlap(
    source: Tracks | Trajectories, cutoff: float, *, lags: IntArray | None = None
) -> Overlap:
    """Self-overlap and four-point susceptibility.

    ``Q(s, t) = n^-1 sum_i [ |r_i(s + t) - r_i(s)| <= cutoff ]`` over the n cells present at both
    times; ``Q(t)`` is its average over cells and origins, and ``chi_4(t) = n Var_s Q(s, t)``.
    The variance is taken as half the mean-square difference of two origins at least t apart:
    displacements over overlapping intervals are not independent, and the plain variance over all
    origins would come out low.

    Parameters
    ----------
    source
        Trajectories.
    cutoff
        Distance within which a cell counts as not having moved, in length units.
    lags
        Lags in frames, increasing; about 35 evenly spaced in the logarithm when None.

    Returns
    -------
    Overlap
        Errors of Q: jackknife over blocks of tracks. Errors of chi_4: jackknife over stretches
        of time origins, each at least 2 t long; NaN when fewer than 4 such stretches fit. chi_4 is
        undefined (NaN) when no two origins lie t apart, that is for t beyond half the movie.

    References
    ----------
    Lacevic, Starr, Schroder & Glotzer, J. Chem. Phys. 119, 7372 (2003), doi:10.1063/1.1605094.
    """
    if not cutoff > 0:
        raise ValueError(f"cutoff must be > 0, got {cutoff}")
    paths, chosen, blocks = _prepare(source, lags, 1)
    inside, pairs, by_track = kernels.overlap_series(paths, chosen, cutoff)
    counts = sum_by_block(kernels.pair_counts(paths, chosen), blocks)
    time = _lag_time(chosen, paths)
    average = LagAverage(time, sum_by_block(by_track, blocks), counts, blocks.method)
    chi = np.array(
        [_susceptibility(i, p, int(m)) for i, p, m in zip(inside, pairs, chosen, strict=True)]
    )
    chi = chi.reshape(-1, 2)
    return Overlap(average.table(), lag_table(time, chi[:, 0], chi[:, 1], counts.sum(axis=0)))


def _susceptibility(inside: FloatArray, pairs: FloatArray, lag: int) -> tuple[float, float]:
    """chi_4 at one lag and its error, from the series over time origins."""
    origins = np.flatnonzero(pairs > 0)
    if origins.size < 2:
        return np.nan, np.nan
    series = np.full(pairs.size, np.nan)
    series[origins] = inside[origins] / pairs[origins]
    value = _lagged_variance(series, lag)
    n_cells = float(pairs[origins].mean())
    span = int(origins[-1] - origins[0]) + 1
    stretches = min(20, span // (2 * lag))
    if stretches < 4:
        return n_cells * value, np.nan
    replicates = np.empty(stretches)
    edges = origins[0] + np.arange(stretches + 1) * span // stretches
    for b in range(stretches):
        without = series.copy()
        without[edges[b] : edges[b + 1]] = np.nan
        replicates[b] = _lagged_variance(without, lag)
    return n_cells * value, n_cells * float(jackknife_error(replicates))


def _lagged_variance(series: FloatArray, lag: int) -> float:
    """Half the mean-square difference of all pairs of values at least lag apart.

    Running sums make it linear in the length: sum over pairs of (a - b)^2
    = sum_b [n_b b^2 - 2 b S_b + S2_b] with the sums over the earlier values.
    """
    ok = np.isfinite(series)
    # Centring first keeps the running sums free of cancellation.
    value = np.where(ok, series - series[ok].mean(), 0.0) if ok.any() else np.zeros_like(series)
    earlier = [np.cumsum(a)[:-lag] for a in (ok.astype(float), value, value**2)]
    later_ok, later = ok[lag:], value[lag:]
    n_pairs = float(np.sum(earlier[0] * later_ok))
    if n_pairs == 0:
        return float(np.nan)
    squares = earlier[0] * later**2 - 2 * later * earlier[1] + earlier[2]
    return 0.5 * float(np.sum(squares[later_ok])) / n_pairs

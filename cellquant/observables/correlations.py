"""How velocities remember their direction, in time and in space, and motion within the cage."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from scipy.sparse import csr_array
from scipy.special import j0

from cellquant.observables.blocks import (
    jackknife_error,
    leave_one_out,
    ratio_with_error,
    spatial_blocks,
)
from cellquant.observables.bonds import neighbour_pairs
from cellquant.observables.dynamics import LagAverage
from cellquant.observables.motion import displacements
from cellquant.observables.pairs import pairs_within
from cellquant.observables.trajectories import FloatArray, IntArray, Trajectories, log_lags


def velocity_autocorrelation(paths: Trajectories, *, lags: IntArray | None = None) -> LagAverage:
    """Velocity autocorrelation ``C(t) = < v_i(s) . v_i(s + t) >``.

    Velocities are displacements over one frame interval divided by it.

    Parameters
    ----------
    paths
        Trajectories.
    lags
        Lags in frames, increasing, from 0; 0 and about 35 more when None.

    Returns
    -------
    LagAverage
        In squared length per squared time. Smoothing over n points correlates velocities less
        than n frames apart.
    """
    blocks = spatial_blocks(paths.centre, box=paths.box)
    if lags is None:
        lags = np.r_[0, log_lags(paths.max_lag - 1)]
    sums, counts = np.zeros((blocks.n, lags.size)), np.zeros((blocks.n, lags.size))
    for first, last in paths.spans():
        entries, row = paths.rows_of(first, last)
        dx, dy, _, entry = displacements(paths, 1, first=first, last=last)
        vx, vy, ok = np.zeros(row.size), np.zeros(row.size), np.zeros(row.size, dtype=bool)
        entry = entry - entries.start
        vx[entry], vy[entry], ok[entry] = dx, dy, True
        for m, lag in enumerate(lags.tolist()):
            end = max(row.size - lag, 0)
            both = np.flatnonzero(ok[:end] & ok[lag:] & (row[:end] == row[lag:]))
            product = vx[both] * vx[both + lag] + vy[both] * vy[both + lag]
            place = blocks.index[row[both]]
            sums[:, m] += np.bincount(place, weights=product, minlength=blocks.n)
            counts[:, m] += np.bincount(place, minlength=blocks.n)
    scale = paths.frame_interval
    return LagAverage(lags.astype(np.float64) * scale, sums / scale**2, counts, blocks.method)


def persistence_time(correlation: LagAverage, *, first_lag: int, interval: float) -> dict[str, Any]:
    """Persistence time from the decay of the velocity autocorrelation.

    Least squares of ``ln C = a - t/P`` over the lags from first_lag on, as long as C exceeds
    three standard errors and a tenth of its first value; for displacements over a finite
    interval of a persistent random walk this decay is exactly exponential from lag 1 on.

    Parameters
    ----------
    correlation
        Velocity autocorrelation by block.
    first_lag
        First lag used, in frames: 1, or the width of the moving average.
    interval
        Frame interval.

    Returns
    -------
    dict
        persistence_time with std_error and fit_range; None with a reason when fewer than two
        lags qualify or the correlation does not decay by more than two standard errors.
    """
    value, error = ratio_with_error(correlation.sums, correlation.counts)
    found: dict[str, Any] = {"persistence_time": None, "persistence_time_std_error": None}
    if not (value > 0).any():
        moved = bool((correlation.sums != 0).any())
        reason = "the velocity correlation is nowhere above zero" if moved else "no cell moved"
        return {**found, "reason": reason}
    after = np.flatnonzero(correlation.lag_time >= (first_lag - 1e-9) * interval)
    good = []
    for k in after:
        if not (value[k] > 3 * error[k] and value[k] >= 0.1 * value[after[0]]):
            break
        good.append(int(k))
    if len(good) < 2:
        reason = f"the velocity correlation is within its error of zero {first_lag + 1} frames on"
        return {**found, "reason": reason}
    time = correlation.lag_time[good]
    centred = time - time.mean()

    def rate(curve: FloatArray) -> FloatArray:
        with np.errstate(invalid="ignore", divide="ignore"):
            slope: FloatArray = (np.log(curve[..., good]) * centred).sum(-1) / (centred**2).sum()
        return -slope

    with np.errstate(invalid="ignore", divide="ignore"):
        rest = rate(leave_one_out(correlation.sums) / leave_one_out(correlation.counts))
    best, scatter = float(rate(value)), float(jackknife_error(rest))
    if not best * (time[-1] - time[0]) > 1e-6 or best < 2 * scatter:
        reason = f"the velocity correlation does not decay beyond its error up to {time[-1]:g}"
        return {**found, "reason": reason}
    std_error = float(jackknife_error(1 / rest)) if (rest > 0).all() else float("nan")
    entry: dict[str, Any] = {
        "persistence_time": 1 / best,
        "persistence_time_std_error": std_error,
        "fit_range": [float(time[0]), float(time[-1])],
        "std_error_method": correlation.method,
    }
    if not np.isfinite(std_error):
        few = "the error needs at least two replicate blocks, and a decay without each of them"
        entry["std_error_reason"] = few
    return entry


def _origins(paths: Trajectories, max_frames: int) -> IntArray:
    """At most max_frames frames, evenly spaced, never the last one."""
    last = paths.n_frames - 2
    if last < 0:
        return np.empty(0, dtype=np.int64)
    return np.unique(np.round(np.linspace(0, last, max_frames)).astype(np.int64))


def _present(paths: Trajectories, frame: int) -> tuple[IntArray, IntArray]:
    """Tracks with a position in a frame, and the entries of these positions."""
    entry = paths.offsets[:-1] + frame - paths.first_frame
    inside = (frame >= paths.first_frame) & (entry < paths.offsets[1:])
    track = np.flatnonzero(inside)
    track = track[paths.valid[entry[track]]]
    return track, entry[track]


def _later(
    paths: Trajectories, track: IntArray, entry: IntArray, lag: int
) -> tuple[Any, FloatArray, FloatArray]:
    """Which tracks have a position a lag later, and the displacements, 0 for the others."""
    then = entry + lag
    ok = then < paths.offsets[track + 1]
    ok[ok] = paths.valid[then[ok]]
    dx, dy = np.zeros(track.size), np.zeros(track.size)
    dx[ok] = paths.x[then[ok]] - paths.x[entry[ok]]
    dy[ok] = paths.y[then[ok]] - paths.y[entry[ok]]
    return ok, dx, dy


def _places(paths: Trajectories, track: IntArray, entry: IntArray) -> FloatArray:
    """Positions, wrapped into the box when there is one."""
    place = paths.start[track] + np.column_stack([paths.x[entry], paths.y[entry]])
    if paths.box is not None:
        edges = np.array(paths.box)
        place = np.mod(place, edges)
        place = np.where(place >= edges, 0.0, place)
    return place


@dataclass(frozen=True)
class SpatialCorrelation:
    """Equal-time velocity correlation against distance.

    Attributes
    ----------
    table
        distance, value, std_error, n_pairs.
    summary
        correlation_length (1/e crossing) with its error, or None with a reason and the distance
        that it is above or below.
    """

    table: pd.DataFrame
    summary: dict[str, Any]


def velocity_correlation(
    paths: Trajectories, *, bin_width: float, max_distance: float, max_frames: int = 32
) -> SpatialCorrelation:
    """Spatial correlation of velocities at equal times.

    ``C(r) = < v_i . v_j >_(r_ij = r) / < v^2 >`` over pairs i < j.

    Parameters
    ----------
    paths
        Trajectories.
    bin_width, max_distance
        In length units; max_distance is cut at half the shorter edge of a periodic box.
    max_frames
        Frames used, evenly spaced.

    Returns
    -------
    SpatialCorrelation
        Undefined when nothing moves. Removing the drift of n cells makes C about -1/n at
        distances beyond the correlation length.
    """
    if paths.box is not None:
        max_distance = min(max_distance, 0.5 * min(paths.box))
    n_bins = max(round(max_distance / bin_width), 1)
    edges = np.linspace(0, max_distance, n_bins + 1)
    blocks = spatial_blocks(paths.centre, box=paths.box)
    sums, counts = np.zeros((blocks.n, n_bins)), np.zeros((blocks.n, n_bins))
    square = np.zeros((blocks.n, 2))
    for frame in _origins(paths, max_frames).tolist():
        track, entry = _present(paths, frame)
        ok, dx, dy = _later(paths, track, entry, 1)
        track, entry, dx, dy = track[ok], entry[ok], dx[ok], dy[ok]
        if track.size < 2:
            continue
        np.add.at(square[:, 0], blocks.index[track], dx**2 + dy**2)
        np.add.at(square[:, 1], blocks.index[track], 1.0)
        place = _places(paths, track, entry)
        block = blocks.index[track]
        for first, second, distance in pairs_within(place, max_distance, paths.box):
            ring = np.searchsorted(edges, distance, side="right") - 1
            ring = np.minimum(ring, n_bins - 1)
            product = dx[first] * dx[second] + dy[first] * dy[second]
            for one in (first, second):
                np.add.at(sums, (block[one], ring), 0.5 * product)
                np.add.at(counts, (block[one], ring), 0.5)
    with np.errstate(divide="ignore", invalid="ignore"):
        value = sums.sum(axis=0) / counts.sum(axis=0) * square[:, 1].sum() / square[:, 0].sum()
        speed2 = leave_one_out(square[:, 1]) / leave_one_out(square[:, 0])
        rest = leave_one_out(sums) / leave_one_out(counts) * speed2[:, None]
    value = np.where(np.isfinite(value), value, np.nan)
    table = pd.DataFrame(
        {
            "distance": 0.5 * (edges[1:] + edges[:-1]),
            "value": value,
            "std_error": jackknife_error(rest, counts),
            "n_pairs": np.rint(counts.sum(axis=0)).astype(np.int64),
        }
    )
    summary = _correlation_length(table, rest, moved=bool(square[:, 0].sum() > 0))
    return SpatialCorrelation(table, {**summary, "std_error_method": blocks.method})


def _correlation_length(table: pd.DataFrame, rest: FloatArray, *, moved: bool) -> dict[str, Any]:
    """Where the correlation falls to 1/e, with its error from the curves without each block."""
    seen = table["n_pairs"].to_numpy() > 0
    found: dict[str, Any] = {"correlation_length": None, "correlation_length_std_error": None}
    if not moved or not seen.any():
        return {**found, "reason": "no cell moved" if seen.any() else "no two cells in one frame"}
    r, value = (table[name].to_numpy()[seen] for name in ("distance", "value"))
    best = _falls_to(r, value, float(np.exp(-1)))
    if np.isposinf(best):
        reason = "the correlation stays above 1/e up to the largest distance (above)"
        return {**found, "above": float(r[-1]), "reason": reason}
    if np.isneginf(best):
        reason = "the correlation is below 1/e at the smallest distance (below) already"
        return {**found, "below": float(r[0]), "reason": reason}
    found["correlation_length"] = best
    replicates = np.array([_falls_to(r, curve[seen], float(np.exp(-1))) for curve in rest])
    if len(replicates) < 2 or not np.isfinite(replicates).all():
        found["std_error_reason"] = "without one of the blocks the curve does not fall to 1/e"
        return found
    found["correlation_length_std_error"] = float(jackknife_error(replicates))
    return found


def _falls_to(r: FloatArray, curve: FloatArray, level: float) -> float:
    """First distance at which a curve falls to a level; infinite where it never or always does."""
    low = np.flatnonzero(~(curve >= level))
    if not low.size:
        return float("inf")
    k = int(low[0])
    if k == 0:
        return float("-inf")
    share = (curve[k - 1] - level) / (curve[k - 1] - curve[k])
    return float(r[k - 1] + share * (r[k] - r[k - 1]))


def cage_relative(
    paths: Trajectories, q: float, *, lags: IntArray | None = None, max_frames: int = 32
) -> tuple[LagAverage, LagAverage, int]:
    """Mean-square displacement and F_s relative to the cage of neighbours.

    ``dr_i^CR(t) = dr_i(t) - z_i^-1 sum_j dr_j(t)`` over the Delaunay neighbours j that cell i has
    at the time origin and that are still there a time t later; then ``<|dr^CR|^2>`` and
    ``<J0(q |dr^CR|)>``.

    Parameters
    ----------
    paths
        Trajectories.
    q
        Wave number in inverse length units.
    lags
        Lags in frames; about 35 evenly spaced in the logarithm when None.
    max_frames
        Time origins, evenly spaced.

    Returns
    -------
    msd, scattering : LagAverage
    n_origins : int
        For independent cells with six neighbours the cage-relative MSD is 7/6 of the plain one.

    References
    ----------
    Mazoyer, Ebert, Maret & Keim, EPL 88, 66004 (2009), doi:10.1209/0295-5075/88/66004.
    """
    chosen = log_lags(paths.max_lag) if lags is None else lags
    blocks = spatial_blocks(paths.centre, box=paths.box)
    square, wave, counts = (np.zeros((blocks.n, chosen.size)) for _ in range(3))
    edges = None if paths.box is None else np.array(paths.box)
    origins = _origins(paths, max_frames)
    for frame in origins.tolist():
        track, entry = _present(paths, frame)
        if (track.size < 4 and edges is None) or track.size < 2:
            continue
        pairs, _, _ = neighbour_pairs(_places(paths, track, entry), edges)
        shape = (track.size, track.size)
        cage = csr_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=shape)
        for m, lag in enumerate(chosen.tolist()):
            ok, dx, dy = _later(paths, track, entry, lag)
            if not ok.any():
                continue
            number = cage @ ok.astype(np.float64)
            used = ok & (number > 0)
            held = number[used]
            cx, cy = dx[used] - (cage @ dx)[used] / held, dy[used] - (cage @ dy)[used] / held
            r2 = cx**2 + cy**2
            place = blocks.index[track[used]]
            square[:, m] += np.bincount(place, weights=r2, minlength=blocks.n)
            wave[:, m] += np.bincount(place, weights=j0(q * np.sqrt(r2)), minlength=blocks.n)
            counts[:, m] += np.bincount(place, minlength=blocks.n)
    time = chosen.astype(np.float64) * paths.frame_interval
    return (
        LagAverage(time, square, counts, blocks.method),
        LagAverage(time, wave, counts, blocks.method),
        int(origins.size),
    )

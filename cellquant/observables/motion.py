"""Speeds, velocity correlation in time and space, and how the displacement grows."""

from typing import Any

import numpy as np

from cellquant.observables.blocks import Blocks, jackknife_error, leave_one_out, spatial_blocks
from cellquant.observables.dynamics import LagAverage
from cellquant.observables.trajectories import FloatArray, IntArray, Trajectories


def displacements(
    paths: Trajectories, lag: int, *, first: int = 0, last: int | None = None
) -> tuple[FloatArray, FloatArray, IntArray, IntArray]:
    """All displacements over a lag, of all tracks or of a range of them.

    Parameters
    ----------
    paths
        Trajectories.
    lag
        Lag in frames, >= 1.
    first, last
        Half-open range of tracks.

    Returns
    -------
    dx, dy : numpy.ndarray
        (n,) components in length units.
    track : numpy.ndarray
        (n,) index of the track.
    entry : numpy.ndarray
        (n,) index of the earlier point in the arrays of `paths`.
    """
    entries, row = paths.rows_of(first, paths.n_tracks if last is None else last)
    x, y, valid = paths.x[entries], paths.y[entries], paths.valid[entries]
    i = np.flatnonzero(valid[:-lag] & valid[lag:] & (row[lag:] == row[:-lag]))
    return x[i + lag] - x[i], y[i + lag] - y[i], row[i], i + entries.start


def lengths(paths: Trajectories, lag: int, blocks: Blocks) -> tuple[FloatArray, IntArray]:
    """Lengths of all displacements over a lag, and the block of each, range of tracks by range."""
    # As large as may be needed: what is never filled in takes no memory.
    found = np.empty(paths.x.size)
    block: Any = np.empty(paths.x.size, dtype=np.int16)
    n = 0
    for first, last in paths.spans():
        dx, dy, track, _ = displacements(paths, lag, first=first, last=last)
        found[n : n + dx.size] = np.hypot(dx, dy)
        block[n : n + dx.size] = blocks.index[track]
        n += dx.size
    return found[:n], block[:n]


def speeds(paths: Trajectories) -> tuple[FloatArray, Blocks]:
    """Instantaneous speed ``|r(t + dt) - r(t)| / dt`` with dt one frame interval.

    Returns
    -------
    values : numpy.ndarray
        (n,) speeds in length per time.
    blocks : Blocks
        Replicate block of each, the tracks grouped in space.
    """
    blocks = spatial_blocks(paths.centre, box=paths.box)
    values, block = lengths(paths, 1, blocks)
    values /= paths.frame_interval
    return values, Blocks(block, blocks.n, blocks.method)


def growth_exponent(second: LagAverage) -> dict[str, Any]:
    """Exponent and apparent diffusion coefficient of the mean-square displacement.

    The exponent is the least-squares slope of ln MSD against ln t over lags from a ninth to a
    third of the longest; ``D = MSD/(4 t)`` at the largest of these lags. Both carry jackknife
    errors.

    Parameters
    ----------
    second
        Squared displacements by block.

    Returns
    -------
    dict
        exponent, diffusion_coefficient, each with its std_error; fit_range. None with a reason
        when fewer than three lags lie in the range or nothing moved.
    """
    time = second.lag_time
    empty = {"exponent": None, "diffusion_coefficient": None, "fit_range": None}
    if time.size == 0:
        return {**empty, "reason": "no track has two points"}
    fitted = (time >= time[-1] / 9) & (time <= time[-1] / 3)
    fitted &= second.counts.sum(axis=0) > 0
    if fitted.sum() < 3:
        return {**empty, "reason": "fewer than three lags lie in the range of the fit"}
    span = [float(time[fitted][0]), float(time[fitted][-1])]
    log_time = np.log(time[fitted])
    log_time = log_time - log_time.mean()

    def fit(sums: FloatArray, counts: FloatArray) -> FloatArray:
        with np.errstate(divide="ignore", invalid="ignore"):
            curve = (sums / counts)[..., fitted]
            slope = (np.log(curve) * log_time).sum(axis=-1) / np.sum(log_time**2)
        return np.stack([slope, curve[..., -1] / (4 * span[1])], axis=-1)

    whole = fit(second.sums.sum(axis=0), second.counts.sum(axis=0))
    if not np.isfinite(whole[0]):
        return {**empty, "fit_range": span, "reason": "no cell moved"}
    error = jackknife_error(
        fit(leave_one_out(second.sums), leave_one_out(second.counts)),
        np.repeat(second.counts[:, fitted].sum(axis=1)[:, None], 2, axis=1),
    )
    entry = {
        "exponent": whole[0],
        "exponent_std_error": error[0],
        "diffusion_coefficient": whole[1],
        "diffusion_coefficient_std_error": error[1],
        "fit_range": span,
    }
    if not np.isfinite(error).all():
        entry["std_error_reason"] = "the error needs at least two replicate blocks"
    return entry

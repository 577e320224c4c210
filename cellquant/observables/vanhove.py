"""Distribution of displacements at one lag, its Gaussian core and its exponential tail."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from scipy.optimize import brentq

from cellquant.observables.blocks import (
    jackknife_error,
    leave_one_out,
    spatial_blocks,
)
from cellquant.observables.smoothing import FloatArray, IntArray
from cellquant.observables.trajectories import Trajectories

CORE_REACH = 1.5  # the core ends at this many standard deviations
TAIL_EXCESS = 10.0  # the tail begins where it holds this many times what the core predicts
MIN_TAIL = 30
NORMALISATIONS = {
    "areal": "2 pi int G_s r dr = 1: probability per area",
    "unit_integral": "int G_s dr = 1: the form of the source, prefactor 1/(2 pi r) kept",
}


@dataclass(frozen=True)
class VanHove:
    """Self part of the van Hove function at one lag.

    Attributes
    ----------
    table
        r (bin centre), value and std_error in the areal normalisation, unit_integral and its
        error in the other, gaussian and exponential (the fits, areal), n.
    components
        The distribution of dx and dy together: displacement, value, std_error, n.
    fits
        sigma2, xi with errors, ranges and goodness; None with a reason where there is no fit.
    """

    table: pd.DataFrame
    components: pd.DataFrame
    fits: dict[str, Any]


def displacements(paths: Trajectories, lag: int) -> tuple[FloatArray, FloatArray, IntArray]:
    """All displacements over a lag.

    Parameters
    ----------
    paths
        Trajectories.
    lag
        Lag in frames, >= 1.

    Returns
    -------
    dx, dy : numpy.ndarray
        (n,) components in length units.
    track : numpy.ndarray
        (n,) index of the track.
    """
    row = np.repeat(np.arange(paths.n_tracks), np.diff(paths.offsets))
    both = paths.valid[:-lag] & paths.valid[lag:] & (row[lag:] == row[:-lag])
    i = np.flatnonzero(both)
    return paths.x[i + lag] - paths.x[i], paths.y[i + lag] - paths.y[i], row[i]


def self_van_hove(
    paths: Trajectories,
    lag: int,
    *,
    unit: float = 1.0,
    core_range: tuple[float, float] | None = None,
    tail_range: tuple[float, float] | None = None,
) -> VanHove:
    """Self part of the van Hove function, with fits of core and tail.

    ``G_s(r, t) = < delta(r - |dr|) > / (2 pi r)``, in rings. The core is fitted with
    ``exp(-r^2/(2 sigma^2))`` and the tail with ``exp(-r/xi)``, both as densities per area and by
    maximum likelihood of the displacements inside the range, so that no bin enters. Errors: the
    fits without each block of tracks in turn, at fixed ranges.

    Parameters
    ----------
    paths
        Trajectories, not smoothed.
    lag
        Lag in frames, >= 1.
    unit
        Length in which r is expressed, e.g. the mean cell diameter.
    core_range
        Range of r, in the unit; from 0 to 1.5 sigma, found in four steps from the median,
        when None.
    tail_range
        Range of r, in the unit; from where it holds ten times what the core predicts, at
        least 2 sigma, to the largest displacement when None.

    Returns
    -------
    VanHove
        No core when nothing moves; no tail where no range holds ten times what the core
        predicts and 30 displacements (the distribution is Gaussian as far as it is known).
        Bias: a broad tail reaches into the core's range and makes sigma larger; up to a tenth
        of an automatic tail belongs to the core, which makes xi shorter by a few per cent.

    References
    ----------
    Van Hove, Phys. Rev. 95, 249 (1954), doi:10.1103/PhysRev.95.249.
    Chaudhuri, Berthier & Kob, Phys. Rev. Lett. 99, 060604 (2007),
    doi:10.1103/PhysRevLett.99.060604, for the exponential tail.
    """
    if lag < 1:
        raise ValueError(f"lag must be >= 1 frame, got {lag}")
    dx, dy, track = displacements(paths, lag)
    blocks = spatial_blocks(paths.centre, box=paths.box)
    block = blocks.index[track]
    r = np.hypot(dx, dy) / unit
    fits: dict[str, Any] = {
        "n": int(r.size),
        "sigma2": None, "sigma2_std_error": None, "core_range": None, "core_chi2_per_dof": None,
        "xi": None, "xi_std_error": None, "tail_range": None, "tail_chi2_per_dof": None,
        "std_error_method": blocks.method,
    }  # fmt: skip
    if r.size == 0:
        fits["reason"] = "no track has two points that far apart in time"
        return VanHove(_histogram(r, block, blocks.n, fits), _components(dx, dy, block, 0), fits)
    if not r.max() > 0:
        fits["reason"] = "no cell moved"
    else:
        _fit_core(r, block, blocks.n, core_range, fits)
        _fit_tail(r, block, blocks.n, tail_range, fits)
    table = _histogram(r, block, blocks.n, fits)
    _goodness(table, fits)
    return VanHove(table, _components(dx / unit, dy / unit, block, blocks.n), fits)


def _fit_core(
    r: FloatArray, block: IntArray, n: int, given: tuple[float, float] | None, fits: dict[str, Any]
) -> None:
    """Maximum likelihood of a truncated Rayleigh law: r^2 is a truncated exponential."""
    square = r * r
    low, high = given or (0.0, 0.0)
    if given is None:
        high = CORE_REACH * np.sqrt(np.median(square) / (2 * np.log(2)))
        for _ in range(3):
            inside = square <= high**2
            sigma2 = _truncated_scale(float(square[inside].mean()), 0.0, high**2) / 2
            if not np.isfinite(sigma2):
                break
            high = CORE_REACH * np.sqrt(sigma2)
    inside = (square >= low**2) & (square <= high**2)
    count = np.bincount(block[inside], weights=np.ones(inside.sum()), minlength=n)
    total = np.bincount(block[inside], weights=square[inside], minlength=n)
    if count.sum() < MIN_TAIL:
        fits["core_reason"] = f"fewer than {MIN_TAIL} displacements lie in the core"
        return
    best = _truncated_scale(float(total.sum() / count.sum()), low**2, high**2) / 2
    if not np.isfinite(best):
        fits["core_reason"] = "the core does not fall off inside its range"
        return
    fits.update(sigma2=best, core_range=[float(low), float(high)], core_n=int(count.sum()))
    fits["core_msd"] = 2 * best
    fits["sigma2_std_error"] = _error(
        total, count, lambda m: _truncated_scale(m, low**2, high**2) / 2
    )


def _truncated_scale(mean: float, low: float, high: float) -> float:
    """Scale s of exp(-u/s) on [low, high] whose mean is the given one; NaN where there is none."""
    width, target = high - low, mean - low
    if not 0 < target < width / 2:
        return float("nan")

    def excess(s: float) -> float:
        ratio = width / s
        return s - (width / np.expm1(ratio) if ratio < 700 else 0.0) - target

    return float(brentq(excess, target / 2, width * 1e6, xtol=1e-14 * width, rtol=1e-13))


def _fit_tail(
    r: FloatArray, block: IntArray, n: int, given: tuple[float, float] | None, fits: dict[str, Any]
) -> None:
    sigma2 = fits["sigma2"]
    if given is None and sigma2 is None:
        fits["tail_reason"] = "the tail is placed by the width of the core, which is not known"
        return
    largest = float(r.max())
    low, high = given or (_tail_start(r, fits), np.inf)
    if not np.isfinite(low):
        fits["tail_reason"] = (
            f"nowhere does the distribution hold {TAIL_EXCESS:g} times what its Gaussian core "
            f"predicts, with {MIN_TAIL} displacements beyond"
        )
        return
    inside = (r >= low) & (r <= high)
    count = np.bincount(block[inside], weights=np.ones(inside.sum()), minlength=n)
    total = np.bincount(block[inside], weights=r[inside], minlength=n)
    fits["tail_range"] = [float(low), min(float(high), largest)]
    fits["tail_n"] = int(count.sum())
    if count.sum() < MIN_TAIL:
        fits["tail_reason"] = f"fewer than {MIN_TAIL} displacements lie in the tail"
        return
    best = _tail_length(float(total.sum() / count.sum()), low, high)
    if not np.isfinite(best):
        fits["tail_reason"] = "the tail does not fall off inside its range"
        return
    fits["xi"] = best
    fits["xi_std_error"] = _error(total, count, lambda m: _tail_length(m, low, high))


def _tail_start(r: FloatArray, fits: dict[str, Any]) -> float:
    """First r, in tenths of sigma from two on, beyond which the core explains a tenth at most."""
    sigma2 = fits["sigma2"]
    start, stop = fits["core_range"]
    share = np.exp(-(start**2) / (2 * sigma2)) - np.exp(-(stop**2) / (2 * sigma2))
    places = np.sqrt(sigma2) * (2 + 0.1 * np.arange(61))
    beyond = r.size - np.searchsorted(np.sort(r), places)
    predicted = fits["core_n"] / share * np.exp(-(places**2) / (2 * sigma2))
    good = np.flatnonzero((beyond >= TAIL_EXCESS * predicted) & (beyond >= MIN_TAIL))
    return float(places[good[0]]) if good.size else float("inf")


def _tail_length(mean: float, low: float, high: float) -> float:
    """Length xi of the density r exp(-r/xi) on [low, high] whose mean is the given one."""

    def excess(xi: float) -> float:
        a = low / xi
        above, below = a * a + 2 * a + 2, a + 1
        if np.isfinite(high):
            b = high / xi
            gone = np.exp(a - b)
            above -= (b * b + 2 * b + 2) * gone
            below -= (b + 1) * gone
        return float(xi * above / below - mean)

    bottom, top = (mean - low) / 4, 1e3 * mean
    if not bottom > 0 or excess(bottom) >= 0 or excess(top) <= 0:
        return float("nan")
    return float(brentq(excess, bottom, top, xtol=1e-14 * mean, rtol=1e-13))


def _error(total: Any, count: Any, solve: Any) -> float:
    used = count > 0
    rest = leave_one_out(total[used]) / np.maximum(leave_one_out(count[used]), 1)
    return float(jackknife_error(np.array([solve(float(m)) for m in rest])))


def _histogram(r: FloatArray, block: IntArray, n: int, fits: dict[str, Any]) -> pd.DataFrame:
    """Rings a fifth of sigma wide (at most 400), with both normalisations and both fits."""
    names = (
        "r", "value", "std_error", "unit_integral", "unit_integral_std_error", "gaussian",
        "exponential",
    )  # fmt: skip
    if r.size == 0 or not r.max() > 0:
        return pd.DataFrame({**{k: np.empty(0) for k in names}, "n": np.empty(0, np.int64)})
    sigma2 = fits["sigma2"] or float(np.mean(r * r) / 2)
    n_bins = int(np.clip(np.ceil(r.max() / (0.2 * np.sqrt(sigma2))), 10, 400))
    edges = np.linspace(0, float(r.max()), n_bins + 1)
    width = edges[1]
    ring = np.minimum((r / width).astype(np.int64), n_bins - 1)
    hits = np.zeros((n, n_bins))
    np.add.at(hits, (block, ring), 1.0)
    size = hits.sum(axis=1)
    centre = 0.5 * (edges[1:] + edges[:-1])
    areas = np.pi * np.diff(edges**2)

    def both(counts: FloatArray, sizes: FloatArray) -> FloatArray:
        areal = counts / areas / sizes[..., None]
        return np.stack([areal, areal / (areal.sum(axis=-1, keepdims=True) * width)], axis=-1)

    value = both(hits.sum(axis=0), size.sum())
    used = size > 0
    error = np.full_like(value, np.nan)
    if used.sum() >= 2:
        error = jackknife_error(both(leave_one_out(hits[used]), leave_one_out(size[used])))
    total = hits.sum(axis=0)
    table = pd.DataFrame(
        {
            "r": centre,
            "value": value[:, 0],
            "std_error": error[:, 0],
            "unit_integral": value[:, 1],
            "unit_integral_std_error": error[:, 1],
            "gaussian": np.nan,
            "exponential": np.nan,
            "n": total.astype(np.int64),
        }
    )
    if fits["sigma2"] is not None:
        low, high = fits["core_range"]
        share = np.exp(-(low**2) / (2 * sigma2)) - np.exp(-(high**2) / (2 * sigma2))
        level = fits["core_n"] / r.size / (share * 2 * np.pi * sigma2)
        table["gaussian"] = level * np.exp(-(centre**2) / (2 * sigma2))
    if fits["xi"] is not None:
        xi, (low, high) = fits["xi"], fits["tail_range"]
        mass = xi * ((low + xi) - (high + xi) * np.exp((low - high) / xi))
        level = fits["tail_n"] / r.size / (2 * np.pi * mass)
        # Only from where the tail begins: the fit says nothing about smaller r.
        table["exponential"] = np.where(centre >= low, level * np.exp((low - centre) / xi), np.nan)
    return table


def _goodness(table: pd.DataFrame, fits: dict[str, Any]) -> None:
    """Squared deviations over squared errors, per ring that lies in the range and holds >= 5."""
    centre, value, error = (table[k].to_numpy() for k in ("r", "value", "std_error"))
    for name, fit, value_name in (("core", "gaussian", "sigma2"), ("tail", "exponential", "xi")):
        if fits[value_name] is None:
            continue
        low, high = fits[f"{name}_range"]
        used = (centre >= low) & (centre <= high) & (error > 0) & (table["n"].to_numpy() >= 5)
        if used.sum() > 2:
            pull = (value[used] - table[fit].to_numpy()[used]) / error[used]
            fits[f"{name}_chi2_per_dof"] = float(np.sum(pull**2) / (used.sum() - 2))


def _components(dx: FloatArray, dy: FloatArray, block: IntArray, n: int) -> pd.DataFrame:
    """Distribution of dx and dy, pooled: the one-dimensional van Hove function."""
    names = ("displacement", "value", "std_error")
    spread = float(np.sqrt(np.mean(dx**2 + dy**2) / 2)) if dx.size else 0.0
    if spread == 0.0:
        return pd.DataFrame({**{k: np.empty(0) for k in names}, "n": np.empty(0, np.int64)})
    reach = float(max(np.abs(dx).max(), np.abs(dy).max()))
    half = int(np.clip(np.ceil(reach / (0.2 * spread)), 10, 200))
    edges = np.linspace(-reach, reach, 2 * half + 1)
    hits = np.zeros((n, 2 * half))
    for component in (dx, dy):
        place = np.clip(np.searchsorted(edges, component, side="right") - 1, 0, 2 * half - 1)
        np.add.at(hits, (block, place), 1.0)
    size = hits.sum(axis=1)
    width = edges[1] - edges[0]
    used = size > 0
    error = np.full(2 * half, np.nan)
    if used.sum() >= 2:
        left = leave_one_out(hits[used]) / leave_one_out(size[used])[:, None]
        error = jackknife_error(left) / width
    return pd.DataFrame(
        {
            "displacement": 0.5 * (edges[1:] + edges[:-1]),
            "value": hits.sum(axis=0) / (size.sum() * width),
            "std_error": error,
            "n": hits.sum(axis=0).astype(np.int64),
        }
    )

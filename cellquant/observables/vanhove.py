"""Distribution of displacements at one lag, its Gaussian core and its exponential tail."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd

from cellquant.observables.blocks import (
    Blocks,
    jackknife_error,
    leave_one_out,
    spatial_blocks,
)
from cellquant.observables.core_and_tail import END_OF_CORE, Core, Tail, fit_core_and_tail
from cellquant.observables.motion import displacements, lengths
from cellquant.observables.trajectories import FloatArray, IntArray, Trajectories

NORMALISATIONS = {
    "areal": "2 pi int G_s r dr = 1: probability per area",
    "unit_integral": "int G_s dr = 1: the form of the source, prefactor 1/(2 pi r) kept",
}
CORE_FORM = (
    "exp(-r^2/sigma2): sigma2 is the mean-square displacement of the core, twice the variance of "
    "one component"
)
TAIL_FORM = "exp(-r/xi), as a density per area"


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
    ``exp(-r^2/sigma2)`` and the tail with ``exp(-r/xi)``, both as densities per area and by
    maximum likelihood of the displacements inside the range, so that no bin enters. sigma2 is
    thus the mean-square displacement of the core, twice the variance of one component, which is
    given as ``component_variance``. Errors: the fits, with their choice of ranges, without each
    block of tracks in turn.

    Parameters
    ----------
    paths
        Trajectories, not smoothed.
    lag
        Lag in frames, >= 1.
    unit
        Length in which r is expressed, e.g. the mean cell diameter.
    core_range
        Range of r, in the unit; from 0 to 1.5 standard deviations of one component, found in
        four steps from the median, when None.
    tail_range
        Range of r, in the unit; from where it holds ten times what the core predicts, at
        least 2 standard deviations, to the largest displacement when None; where it nowhere
        does, from 3 standard deviations on.

    Returns
    -------
    VanHove
        No core when nothing moves; no tail with fewer than 30 displacements in its range. Up to a
        tenth of a tail that stands out belongs to the core: what the fitted core predicts there
        is taken out before xi is fitted (a range that is given is fitted as it is). Where none
        stands out xi is the local decay length of the core, and ``tail_note`` says so.
        Bias: a broad tail reaches into the core's range and makes sigma2 larger; where the decay
        is hardly longer than the core is wide, xi comes out short by a tenth and more.

    References
    ----------
    Van Hove, Phys. Rev. 95, 249 (1954), doi:10.1103/PhysRev.95.249.
    Chaudhuri, Berthier & Kob, Phys. Rev. Lett. 99, 060604 (2007),
    doi:10.1103/PhysRevLett.99.060604, for the exponential tail.
    """
    if lag < 1:
        raise ValueError(f"lag must be >= 1 frame, got {lag}")
    blocks = spatial_blocks(paths.centre, box=paths.box)
    r, block = lengths(paths, lag, blocks)
    r /= unit
    r, block = _in_order(r, block)
    fits: dict[str, Any] = {
        "n": int(r.size),
        "sigma2": None, "sigma2_std_error": None, "component_variance": None,
        "component_variance_std_error": None, "core_range": None, "core_chi2_per_dof": None,
        "xi": None, "xi_std_error": None, "tail_range": None, "tail_chi2_per_dof": None,
        "std_error_method": blocks.method,
    }  # fmt: skip
    core, tail = None, None
    if r.size == 0:
        fits["reason"] = "no track has two points that far apart in time"
    elif not r[-1] > 0:
        fits["reason"] = "no cell moved"
    else:
        fitted = fit_core_and_tail(r, block, blocks.n, core_range=core_range, tail_range=tail_range)
        fits.update(_describe(*fitted, longest=float(r[-1])))
        core = fitted[0] if fitted[0].reason is None else None
        tail = fitted[2] if fitted[2].reason is None else None
    squares = sum(float((part * part).sum()) for part in _stretches(r))
    spread = float(np.sqrt(squares / max(r.size, 1) / 2))
    sigma2 = core.sigma2 if core is not None else 2 * spread**2
    table = _histogram(r, block, blocks.n, sigma2, core, tail)
    _goodness(table, fits)
    return VanHove(table, _components(paths, lag, unit, blocks, spread), fits)


def _describe(
    core: Core, sigma2_error: float, tail: Tail, xi_error: float, longest: float
) -> dict[str, Any]:
    """The fits as summary entries; only what is known, and the reason where it is not."""
    found: dict[str, Any] = {}
    if core.reason is not None:
        found["core_reason"] = core.reason
    else:
        found.update(sigma2=core.sigma2, sigma2_std_error=sigma2_error)
        found.update(component_variance=core.sigma2 / 2)
        found.update(component_variance_std_error=sigma2_error / 2)
        found.update(core_range=[core.low, core.high], core_n=core.n)
    if tail.n:
        found["tail_range"] = [tail.low, min(tail.high, longest)]
        found.update(tail_n=tail.n, tail_core_n=tail.n_core, tail_excess=tail.excess)
        found["tail_rule"] = tail.rule
    if tail.rule == END_OF_CORE and tail.reason is None:
        found["tail_note"] = (
            "no exponential tail stands out from the core; xi is the local decay length of the "
            "core where it ends"
        )
    if tail.reason is not None:
        found["tail_reason"] = tail.reason
    else:
        found.update(xi=tail.xi, xi_std_error=xi_error)
    return found


def _histogram(
    r: FloatArray,
    block: IntArray,
    n: int,
    sigma2: float,
    core: Core | None,
    tail: Tail | None,
) -> pd.DataFrame:
    """Rings a fifth of a component's width wide (at most 400), both normalisations and fits."""
    names = (
        "r", "value", "std_error", "unit_integral", "unit_integral_std_error", "gaussian",
        "exponential",
    )  # fmt: skip
    if r.size == 0 or not r[-1] > 0:
        return pd.DataFrame({**{k: np.empty(0) for k in names}, "n": np.empty(0, np.int64)})
    longest = float(r[-1])
    n_bins = int(np.clip(np.ceil(longest / (0.2 * np.sqrt(sigma2 / 2))), 10, 400))
    edges = np.linspace(0, longest, n_bins + 1)
    width = edges[1]
    hits = np.zeros((n, n_bins))
    for part, members in zip(_stretches(r), _stretches(block), strict=True):
        ring = np.minimum((part / width).astype(np.int64), n_bins - 1)
        np.add.at(hits, (members, ring), 1.0)
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
    if core is not None:
        level = core.beyond(0.0) / r.size / (np.pi * sigma2)
        table["gaussian"] = level * np.exp(-(centre**2) / sigma2)
    if tail is not None:
        xi, low, high = tail.xi, tail.low, min(tail.high, longest)
        mass = xi * ((low + xi) - (high + xi) * np.exp((low - high) / xi))
        level = (tail.n - tail.n_core) / r.size / (2 * np.pi * mass)
        # Only from where the tail begins: the fit says nothing about smaller r.
        table["exponential"] = np.where(centre >= low, level * np.exp((low - centre) / xi), np.nan)
    return table


def _in_order(r: FloatArray, block: IntArray) -> tuple[FloatArray, IntArray]:
    """Lengths and their blocks by length, sorted slice by slice to hold one order at a time."""
    cuts = np.sort(r[::1024])[::64]
    sorted_r, sorted_block = np.empty_like(r), np.empty_like(block)
    n = 0
    for low, high in pairwise((-np.inf, *cuts, np.inf)):
        inside = np.flatnonzero((r >= low) & (r < high))
        inside = inside[np.argsort(r[inside], kind="stable")]
        sorted_r[n : n + inside.size], sorted_block[n : n + inside.size] = r[inside], block[inside]
        n += inside.size
    return sorted_r, sorted_block


def _stretches(values: Any) -> list[Any]:
    """Views of an array, a few values at a time."""
    return [values[start : start + 2**15] for start in range(0, len(values), 2**15)]


def _goodness(table: pd.DataFrame, fits: dict[str, Any]) -> None:
    """Squared deviations over squared errors, per ring that lies in the range and holds >= 5."""
    centre, value, error = (table[k].to_numpy() for k in ("r", "value", "std_error"))
    for name, fit, value_name in (("core", "gaussian", "sigma2"), ("tail", "exponential", "xi")):
        if fits[value_name] is None:
            continue
        low, high = fits[f"{name}_range"]
        used = (centre >= low) & (centre <= high) & (error > 0) & (table["n"].to_numpy() >= 5)
        if used.sum() > 2:
            expected = table[fit].to_numpy()[used]
            if name == "tail" and fits["tail_core_n"]:
                expected = expected + table["gaussian"].to_numpy()[used]
            pull = (value[used] - expected) / error[used]
            fits[f"{name}_chi2_per_dof"] = float(np.sum(pull**2) / (used.sum() - 2))


def _components(
    paths: Trajectories, lag: int, unit: float, blocks: Blocks, spread: float
) -> pd.DataFrame:
    """Distribution of dx and dy, pooled: the one-dimensional van Hove function."""
    names = ("displacement", "value", "std_error")
    if spread == 0.0:
        return pd.DataFrame({**{k: np.empty(0) for k in names}, "n": np.empty(0, np.int64)})

    def parts() -> Iterator[tuple[FloatArray, IntArray]]:
        for first, last in paths.spans():
            dx, dy, track, _ = displacements(paths, lag, first=first, last=last)
            for component in (dx, dy):
                yield component / unit, blocks.index[track]

    reach = max(float(np.abs(component).max(initial=0.0)) for component, _ in parts())
    half = int(np.clip(np.ceil(reach / (0.2 * spread)), 10, 200))
    edges = np.linspace(-reach, reach, 2 * half + 1)
    hits = np.zeros((blocks.n, 2 * half))
    for component, block in parts():
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

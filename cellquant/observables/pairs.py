"""Pair correlation of the cell centres."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats
from scipy.spatial import cKDTree

from cellquant.observables.blocks import jackknife_error, leave_one_out, ratio_with_error
from cellquant.observables.layer import Layer, blocks_of, layer_of, positions_by_frame
from cellquant.observables.region import Region
from cellquant.observables.trajectories import FloatArray, IntArray
from cellquant.rows import Scan
from cellquant.tables import Cells, Tracks


@dataclass(frozen=True)
class PairCorrelation:
    """g(r) and its highest peak.

    Attributes
    ----------
    table
        distance, value, std_error, n_pairs.
    peak
        peak_distance, peak_height and their errors; None with a reason where there is no peak.
    """

    table: pd.DataFrame
    peak: dict[str, Any]


def pair_correlation(
    source: Tracks | Cells | Scan | Layer,
    *,
    diameter: float | None = None,
    max_distance: float | None = None,
    bin_width: float | None = None,
    max_frames: int = 32,
) -> PairCorrelation:
    """Pair correlation function.

    ``g(r) = pairs in the ring / pairs expected of independent points``. In a periodic box the
    expectation is ``N (N - 1)/2 x ring area / box area``; in an open rectangle a x b it carries
    the exact fraction of the ring that lies inside, averaged over places and directions,
    ``1 - 2 r (a + b)/(pi a b) + r^2/(pi a b)``. Where cells fill the rectangle in part only
    (`find_region`), the area W that they can occupy takes its place: ``N (N - 1)/2 x ring area x
    gamma(r)/W^2`` with gamma(r) the area that W shares with itself moved by r.

    Parameters
    ----------
    source
        Tracks, cells, or a layer.
    diameter
        Mean cell diameter, for the defaults; from the density when None.
    max_distance
        Largest r; five diameters, at most half of the shorter edge.
    bin_width
        Width of the rings; a twentieth of a diameter when None.
    max_frames
        Frames used, evenly spaced.

    Returns
    -------
    PairCorrelation
        Errors: jackknife over blocks of cells; in an open field these include the difference
        between border and centre and are too large at long range. The peak is the highest
        place, refined by a parabola whose weights fall off over two rings around its own vertex,
        which lowers a narrow peak. Empty with fewer than two cells; no peak where no five rings
        together exceed 1 at a level of 1 % for all places.

    References
    ----------
    Ohser & Stoyan, Biom. J. 23, 523 (1981), doi:10.1002/bimj.4710230602.
    """
    layer = layer_of(source, max_frames=max_frames)
    names = ("distance", "value", "std_error")
    frames = [
        (rows, place, region)
        for (rows, place), region in zip(positions_by_frame(layer), layer.regions, strict=True)
        if len(rows) >= 2
    ]
    if not frames or not (layer.edges > 0).all():
        table = pd.DataFrame({**{k: np.empty(0) for k in names}, "n_pairs": np.empty(0, np.int64)})
        reason = "fewer than two cells in every frame, or all on a line"
        return PairCorrelation(table, {**_NO_PEAK, "reason": reason})
    area = float(np.prod(layer.edges)) * layer.filled
    d = diameter or float(np.sqrt(area / np.mean([len(r) for r, _, _ in frames])))
    reach = min(max_distance or 5 * d, 0.5 * float(layer.edges.min()))
    n_bins = max(int(np.floor(reach / (bin_width or d / 20))), 1)
    edges = np.linspace(0, reach, n_bins + 1)
    blocks, box = blocks_of(layer), layer.edges if layer.periodic else None
    found, expected_pairs = np.zeros((blocks.n, n_bins)), np.zeros((blocks.n, n_bins))
    for rows, place, region in frames:
        block = blocks.index[rows]
        for first, second, gap in pairs_within(place, reach, box):
            ring = np.minimum(np.searchsorted(edges, gap, side="right") - 1, n_bins - 1)
            for one in (first, second):
                np.add.at(found, (block[one], ring), 0.5)
        members = np.bincount(block, minlength=blocks.n)
        expected_pairs += np.outer(0.5 * (len(rows) - 1) * members, _share(layer, region, edges))
    value, error = ratio_with_error(found, expected_pairs)
    distance = 0.5 * (edges[1:] + edges[:-1])
    table = pd.DataFrame(
        {
            "distance": distance,
            "value": value,
            "std_error": error,
            "n_pairs": np.rint(found.sum(axis=0)).astype(np.int64),
        }
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        rest = leave_one_out(found) / leave_one_out(expected_pairs)
    peak = _highest(distance, value, rest, expected_pairs.sum(axis=0))
    return PairCorrelation(table, {**peak, "std_error_method": blocks.method})


def _share(layer: Layer, region: Region | None, edges: FloatArray) -> FloatArray:
    """Probability that two independent points of the layer lie each ring apart."""
    if region is not None:
        middle = 0.5 * (edges[1:] + edges[:-1])
        rings = np.pi * np.diff(edges**2)
        return np.asarray(rings * region.overlap(middle) / region.area**2)
    a, b = layer.edges
    area = float(a * b)
    covered = np.pi * area * edges**2
    if not layer.periodic:
        covered = covered - 4 * (a + b) * edges**3 / 3 + edges**4 / 2
    return np.asarray(np.diff(covered) / area**2)


_NO_PEAK: dict[str, Any] = {
    "peak_distance": None, "peak_distance_std_error": None,
    "peak_height": None, "peak_height_std_error": None,
}  # fmt: skip


def _highest(
    r: FloatArray, value: FloatArray, rest: FloatArray, n_expected: FloatArray
) -> dict[str, Any]:
    """Highest place that stands out from 1, with errors from the curves without each block."""
    if r.size < 8:
        return {**_NO_PEAK, "reason": "fewer than eight rings fit into the field"}
    # Five rings together are looked at, for more pairs. None of independent points should pass in
    # 99 of 100 layers, whatever their number; few pairs have at least the error of their count.
    five = np.ones(5)
    smooth = np.convolve(value, five / 5, "valid")
    spread = jackknife_error(np.array([np.convolve(curve, five / 5, "valid") for curve in rest]))
    spread = np.maximum(spread, np.sqrt(1 / np.convolve(n_expected, five, "valid")))
    reach = stats.t.ppf(1 - 0.01 / smooth.size, max(len(rest) - 1, 1))
    stands_out = smooth - 1 > reach * np.where(np.isfinite(spread), spread, np.inf)
    if not stands_out.any():
        reason = "g(r) nowhere stands out from that of independent positions"
        return {**_NO_PEAK, "reason": reason}
    k = int(np.argmax(np.where(stands_out, smooth, -np.inf))) + 2
    width = 2 * (r[1] - r[0])

    def place(curve: FloatArray) -> tuple[float, float]:
        """Vertex of the parabola fitted around itself, with weights that fall off smoothly."""
        at, level = float(r[k]), float(curve[k])
        for _ in range(10):
            weight = np.exp(-0.25 * ((r - at) / width) ** 2)
            used = np.isfinite(curve) & (weight > 1e-3)
            bend, slope, level = np.polyfit(r[used] - at, curve[used], 2, w=weight[used])
            shift = -slope / (2 * bend) if bend < 0 else np.inf
            if not abs(shift) < width:
                return float(r[k]), float(curve[k])
            at, level = at + shift, level + slope * shift / 2
        return at, level

    distance, height = place(value)
    errors = jackknife_error(np.array([place(curve) for curve in rest]))
    return {
        "peak_distance": distance,
        "peak_distance_std_error": float(errors[0]),
        "peak_height": height,
        "peak_height_std_error": float(errors[1]),
    }


def pairs_within(
    place: FloatArray, reach: float, box: Any = None
) -> Iterator[tuple[IntArray, IntArray, FloatArray]]:
    """Pairs of positions up to a distance, each once: first, second and distance, in pieces.

    Parameters
    ----------
    place
        (n, 2) positions, inside the box where there is one.
    reach
        Largest distance.
    box
        Edges of a periodic box, or None.
    """
    everyone = cKDTree(place, boxsize=box)
    for start in range(0, len(place), 256):
        some = cKDTree(place[start : start + 256], boxsize=box)
        near = some.sparse_distance_matrix(everyone, reach, output_type="ndarray")
        near = near[near["j"] > near["i"] + start]
        yield near["i"] + start, near["j"], near["v"]

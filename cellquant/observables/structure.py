"""Static structure of the layer: structure factor and pair correlation."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats
from scipy.spatial import cKDTree

from cellquant.observables.blocks import (
    Blocks,
    jackknife_error,
    leave_one_out,
    ratio_with_error,
)
from cellquant.observables.shape import cell_blocks
from cellquant.observables.trajectories import FloatArray, IntArray
from cellquant.rows import Scan, rows_of
from cellquant.tables import TRACK_COLUMNS, Cells, Tracks

_GROUPS = 8  # interleaved groups of wave vectors, for the error of the peak


@dataclass(frozen=True)
class Layer:
    """Positions of some frames, and the rectangle they live in.

    Attributes
    ----------
    rows
        Rows of the source in the chosen frames with a finite position.
    frames
        The chosen frame numbers.
    corner, edges
        Lower corner and edges of the rectangle: the periodic box, or the extent of all positions.
    periodic
        Whether the rectangle is a periodic box.
    filled
        Share of the rectangle that cells can occupy, at most 1.
    """

    rows: pd.DataFrame
    frames: IntArray
    corner: FloatArray
    edges: FloatArray
    periodic: bool
    filled: float = 1.0

    @property
    def note(self) -> dict[str, Any]:
        """Summary entries on a rectangle that cells fill in part only; nothing where they do."""
        if self.filled > 0.9:
            return {}
        note = (
            f"cells can occupy {self.filled:.0%} of the rectangle around them: the contrast with "
            "the empty part raises g(r) at every distance, its peak by up to the inverse of this "
            "share, and S(q) at small q"
        )
        return {"filled": self.filled, "note": note}


def layer_of(source: Tracks | Cells | Scan | Layer, *, max_frames: int = 32) -> Layer:
    """Choose at most max_frames frames, evenly spaced, and the rectangle around the cells.

    Of a table on disk only these frames are held. A layer is returned as it is.
    """
    if isinstance(source, Layer):
        return source
    head = source.head if isinstance(source, Scan) else source
    rows = rows_of(source)
    present = np.empty(0, dtype=np.int64)
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for piece in rows.pieces("frame", "x", "y"):
        x, y = piece["x"], piece["y"]
        known = np.isfinite(x) & np.isfinite(y)
        present = np.union1d(present, piece["frame"][known])
        if known.any():
            low = np.minimum(low, (x[known].min(), y[known].min()))
            high = np.maximum(high, (x[known].max(), y[known].max()))
    if present.size > max_frames:
        chosen = np.round(np.linspace(0, present.size - 1, max_frames)).astype(np.int64)
        present = present[chosen]
    box = head.box if isinstance(head, Tracks) else None
    corner, edges = np.zeros(2), np.zeros(2)
    if box is not None:
        edges = np.array(box, dtype=np.float64)
    elif present.size:
        corner, edges = low, high - low
    names = ("frame", "x", "y", "touches_border", *(("track_id",) if rows.linked else ()))
    parts = []
    for piece in rows.pieces(*names):
        used = np.isin(piece["frame"], present)
        used &= np.isfinite(piece["x"]) & np.isfinite(piece["y"])
        parts.append(pd.DataFrame({name: piece[name][used] for name in names}))
    empty = pd.DataFrame({name: np.empty(0, TRACK_COLUMNS[name]) for name in names})
    table = pd.concat(parts, ignore_index=True) if parts else empty
    table = table.sort_values("frame", kind="stable").reset_index(drop=True)
    filled = 1.0
    if box is None and (edges > 0).all():
        area = head.area if isinstance(head, Tracks) else float(np.mean(head.occupied_area))
        filled = min(1.0, area / float(np.prod(edges)))
    return Layer(table, present, corner, edges, box is not None, filled)


def blocks_of(layer: Layer, used: Any = slice(None)) -> Blocks:
    """Replicate blocks of the rows of a layer, or of some of them."""
    rows = layer.rows[used]
    track = rows["track_id"].to_numpy() if "track_id" in rows.columns else None
    box = (float(layer.edges[0]), float(layer.edges[1])) if layer.periodic else None
    return cell_blocks(rows[["x", "y"]].to_numpy(dtype=np.float64), track, box)


def positions_by_frame(layer: Layer) -> list[tuple[IntArray, FloatArray]]:
    """Row numbers and positions of each frame, inside the rectangle."""
    frame = layer.rows["frame"].to_numpy(dtype=np.int64)
    place = layer.rows[["x", "y"]].to_numpy(dtype=np.float64) - layer.corner
    if layer.periodic:
        place = np.mod(place, layer.edges)
        place = np.where(place >= layer.edges, 0.0, place)
    cuts = np.searchsorted(frame, layer.frames)
    groups = np.split(np.arange(frame.size), cuts[1:]) if frame.size else []
    return [(rows, place[rows]) for rows in groups]


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


@dataclass(frozen=True)
class StructureFactor:
    """S(q) and its first peak.

    Attributes
    ----------
    table
        wave_number, value, std_error, n_vectors.
    peak
        q_peak, its std_error and height; None with a reason where there is no peak.
    """

    table: pd.DataFrame
    peak: dict[str, Any]


def structure_factor(
    source: Tracks | Cells | Scan | Layer,
    *,
    diameter: float | None = None,
    max_frames: int = 32,
    max_wave_number: float | None = None,
) -> StructureFactor:
    """Static structure factor of the cell centres.

    ``S(q) = N^-1 |sum_j exp(-i q . r_j)|^2``, averaged over frames, for the wave vectors
    ``q = 2 pi (n_x/L_x, n_y/L_y)``, gathered in shells one ``2 pi/min(L)`` wide. In a periodic
    box these are all there are. In an open field they are the vectors for which the mean density
    of the rectangle drops out, so that no window function has to be subtracted.

    Parameters
    ----------
    source
        Tracks, cells, or a layer.
    diameter
        Mean cell diameter, for the default of max_wave_number.
    max_frames
        Frames used, evenly spaced.
    max_wave_number
        Largest q; four times ``2 pi/diameter``, at least twice ``2 pi sqrt(density)``, when None.

    Returns
    -------
    StructureFactor
        The first peak is the highest shell between 0.6 and 1.6 times ``2 pi sqrt(density)``, the
        wave number of the spacing of the cells, refined by a parabola.
        Errors: spread of the time-averaged values over the vectors of a shell, of the peak:
        jackknife over eight interleaved groups of vectors. Undefined with fewer than two cells
        or no extent in x or y. Bias: in an open field that cells fill unevenly, the smallest q
        measure the envelope of the layer.

    References
    ----------
    Hansen & McDonald, Theory of Simple Liquids (2006), section 4.1.
    """
    layer = layer_of(source, max_frames=max_frames)
    frames = [place for _, place in positions_by_frame(layer) if len(place) >= 2]
    empty = pd.DataFrame({name: np.empty(0) for name in ("wave_number", "value", "std_error")})
    empty["n_vectors"] = np.empty(0, dtype=np.int64)
    none = {"q_peak": None, "q_peak_std_error": None}
    if not frames or not (layer.edges > 0).all():
        reason = "fewer than two cells in every frame, or all on a line"
        return StructureFactor(empty, {**none, "reason": reason})
    density = float(np.mean([len(p) for p in frames])) / float(np.prod(layer.edges))
    # The peak is that of the spacing of the cells: of nuclei alone d is much smaller than it.
    scale = 2 * np.pi * float(np.sqrt(density / layer.filled))
    limit = max(4 * 2 * np.pi / diameter if diameter else 0.0, 2 * scale)
    limit = limit if max_wave_number is None else max_wave_number
    step = 2 * np.pi / layer.edges
    # A field very large for its cells is measured up to the q that half a million vectors reach.
    limit = min(limit, float(np.sqrt(5e5 * np.prod(step))))
    n_x, n_y = np.maximum(np.ceil(np.minimum(limit / step, 1e6)).astype(int), 1)
    q_x, q_y = np.arange(n_x + 1) * step[0], np.arange(-n_y, n_y + 1) * step[1]
    power = np.zeros((q_x.size, q_y.size))
    for place in frames:
        wave_x = np.exp(-1j * np.outer(q_x, place[:, 0]))
        wave_y = np.exp(-1j * np.outer(place[:, 1], q_y))
        power += np.abs(wave_x @ wave_y) ** 2 / len(place)
    power /= len(frames)
    q = np.hypot(*np.meshgrid(q_x, q_y, indexing="ij"))
    # One of each pair q, -q; on the line q_x = 0 that is q_y > 0.
    half = (q > 0) & (q <= limit) & ~((q_x[:, None] == 0) & (q_y[None, :] < 0))
    return _shells(q[half], power[half], float(step.max()), scale)


def _shells(q: FloatArray, power: FloatArray, width: float, scale: float) -> StructureFactor:
    shell = np.floor(q / width - 0.5).astype(np.int64)
    n_shells = int(shell.max()) + 1
    # Vectors below half a width, if the rectangle is elongated, join the first shell.
    shell = np.maximum(shell, 0)
    group = np.arange(q.size) % _GROUPS
    counts = np.zeros((_GROUPS, n_shells))
    sums, wave = np.zeros_like(counts), np.zeros_like(counts)
    np.add.at(counts, (group, shell), 1.0)
    np.add.at(sums, (group, shell), power)
    np.add.at(wave, (group, shell), q)
    n = counts.sum(axis=0)
    filled = n > 0
    n, counts, sums, wave = n[filled], counts[:, filled], sums[:, filled], wave[:, filled]
    mean_q, value = wave.sum(axis=0) / n, sums.sum(axis=0) / n
    renumber = np.cumsum(filled) - 1
    squares = np.bincount(renumber[shell], weights=(power - value[renumber[shell]]) ** 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.where(n >= 2, np.sqrt(squares / (n - 1) / n), np.nan)
    table = pd.DataFrame(
        {"wave_number": mean_q, "value": value, "std_error": error, "n_vectors": n.astype(np.int64)}
    )
    return StructureFactor(table, _first_peak(mean_q, value, error, sums, counts, scale))


def _first_peak(
    q: FloatArray,
    value: FloatArray,
    error: FloatArray,
    sums: FloatArray,
    counts: FloatArray,
    scale: float,
) -> dict[str, Any]:
    """Largest S(q) between 0.6 and 1.6 of the scale, refined by a parabola around it."""
    none: dict[str, Any] = {"q_peak": None, "q_peak_std_error": None}
    window = (q >= 0.6 * scale) & (q <= 1.6 * scale)
    if window.sum() < 3:
        return {**none, "reason": "fewer than three shells lie where the first peak is expected"}
    k = int(np.flatnonzero(window)[np.argmax(value[window])])
    if k in (np.flatnonzero(window)[0], np.flatnonzero(window)[-1]):
        return {
            **none,
            "reason": "S(q) has no maximum between 0.6 and 1.6 times 2 pi sqrt(density)",
        }
    # |sum exp(-i q r)|^2/N of independent points is exponential with mean and spread 1; of a
    # crystal it differs so much between the vectors of a shell that only this bound is of use.
    scatter = 1 / np.sqrt(counts[:, k].sum())
    if not value[k] - 1 > 4 * np.fmin(error[k], scatter):
        reason = "the maximum of S(q) is within the scatter of independent positions"
        return {**none, "reason": reason}
    near = np.abs(q - q[k]) <= max(0.12 * q[k], 1.01 * (q[k + 1] - q[k]), 1.01 * (q[k] - q[k - 1]))

    def place(curve: FloatArray) -> tuple[float, float]:
        bend, slope, level = np.polyfit(q[near] - q[k], curve[near], 2)
        if bend >= 0:
            return float(q[k]), float(curve[k])
        return float(q[k] - slope / (2 * bend)), float(level - slope**2 / (4 * bend))

    found = place(value)
    with np.errstate(divide="ignore", invalid="ignore"):
        curves = leave_one_out(sums) / leave_one_out(counts)
    usable = [c for c in curves if np.isfinite(c[near]).all()]
    spread = (
        jackknife_error(np.array([place(c) for c in usable])) if len(usable) > 1 else [None] * 2
    )
    return {
        "q_peak": found[0],
        "q_peak_std_error": spread[0],
        "height": found[1],
        "height_std_error": spread[1],
        "std_error_method": f"jackknife over {_GROUPS} interleaved groups of wave vectors",
    }


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
    ``1 - 2 r (a + b)/(pi a b) + r^2/(pi a b)``.

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
    """
    layer = layer_of(source, max_frames=max_frames)
    names = ("distance", "value", "std_error")
    frames = [(rows, place) for rows, place in positions_by_frame(layer) if len(rows) >= 2]
    if not frames or not (layer.edges > 0).all():
        table = pd.DataFrame({**{k: np.empty(0) for k in names}, "n_pairs": np.empty(0, np.int64)})
        reason = "fewer than two cells in every frame, or all on a line"
        return PairCorrelation(table, {**_NO_PEAK, "reason": reason})
    area = float(np.prod(layer.edges))
    d = diameter or float(np.sqrt(area / np.mean([len(r) for r, _ in frames])))
    reach = min(max_distance or 5 * d, 0.5 * float(layer.edges.min()))
    n_bins = max(int(np.floor(reach / (bin_width or d / 20))), 1)
    edges = np.linspace(0, reach, n_bins + 1)
    a, b = layer.edges
    covered = 0.5 * edges**2 * 2 * np.pi * area
    if not layer.periodic:
        covered = 2 * np.pi * (area * edges**2 / 2 - 2 * (a + b) * edges**3 / (3 * np.pi))
        covered += edges**4 / 2
    share = np.diff(covered) / area**2
    blocks = blocks_of(layer)
    found = np.zeros((blocks.n, n_bins))
    expected = np.zeros(blocks.n)
    for rows, place in frames:
        tree = cKDTree(place, boxsize=layer.edges if layer.periodic else None)
        pairs = tree.query_pairs(reach, output_type="ndarray")
        gap = _gap(place[pairs[:, 0]], place[pairs[:, 1]], layer)
        ring = np.minimum(np.searchsorted(edges, gap, side="right") - 1, n_bins - 1)
        for side in (0, 1):
            np.add.at(found, (blocks.index[rows[pairs[:, side]]], ring), 0.5)
        np.add.at(expected, blocks.index[rows], 0.5 * (len(rows) - 1))
    expected_pairs = expected[:, None] * share[None]
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


def _gap(first: FloatArray, second: FloatArray, layer: Layer) -> FloatArray:
    delta = first - second
    if layer.periodic:
        delta -= layer.edges * np.round(delta / layer.edges)
    gap: FloatArray = np.hypot(delta[:, 0], delta[:, 1])
    return gap

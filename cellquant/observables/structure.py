"""Static structure factor of the cell centres."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from cellquant.observables import kernels
from cellquant.observables.blocks import jackknife_error, leave_one_out
from cellquant.observables.layer import Layer, layer_of, positions_by_frame
from cellquant.observables.trajectories import FloatArray, IntArray
from cellquant.rows import Scan
from cellquant.tables import Cells, Tracks

_GROUPS = 8  # interleaved groups of wave vectors, for the error of the peak


@dataclass(frozen=True)
class StructureFactor:
    """S(q) and its first peak.

    Attributes
    ----------
    table
        wave_number, value, std_error, n_vectors, n_independent.
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
        Errors: spread of the time-averaged values over the vectors of a shell about a straight
        line in q, of the peak: jackknife over eight interleaved groups of vectors. Both grow by
        the root of n_vectors/n_independent, found from how far the vectors of a shell rise and
        fall together from frame to frame: in a crystal q and G - q measure the same waves. Use t
        with n_vectors - 2 degrees of freedom. Undefined with fewer than two cells or no extent in
        x or y. Bias: in an open field that cells fill unevenly, the smallest q measure the
        envelope of the layer; of a single frame n_independent is taken as n_vectors.

    References
    ----------
    Hansen & McDonald, Theory of Simple Liquids (2006), section 4.1.
    """
    layer = layer_of(source, max_frames=max_frames)
    frames = [place for _, place in positions_by_frame(layer) if len(place) >= 2]
    empty = pd.DataFrame({name: np.empty(0) for name in ("wave_number", "value", "std_error")})
    empty = empty.assign(n_vectors=np.empty(0, dtype=np.int64), n_independent=np.empty(0))
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
    q = np.hypot(*np.meshgrid(q_x, q_y, indexing="ij"))
    # One of each pair q, -q; on the line q_x = 0 that is q_y > 0.
    half = (q > 0) & (q <= limit) & ~((q_x[:, None] == 0) & (q_y[None, :] < 0))
    shells = _Shells.of(q[half], float(step.max()))
    for place in frames:
        real, imaginary = kernels.waves(q_x, q_y, place)
        shells.add(((real**2 + imaginary**2) / len(place))[half])
    return _summarise(shells, scale)


@dataclass
class _Shells:
    """Wave vectors in shells, and the powers of the frames so far.

    q, index and n: wave numbers, their shells, vectors per shell. total and squares: sums over
    frames, per vector and (of the squared powers) per shell. means: of each shell, per frame.
    """

    q: FloatArray
    index: IntArray
    n: FloatArray
    total: FloatArray
    squares: FloatArray
    means: list[FloatArray]

    @classmethod
    def of(cls, q: FloatArray, width: float) -> "_Shells":
        # Vectors below half a width, if the rectangle is elongated, join the first shell.
        shell = np.maximum(np.floor(q / width - 0.5).astype(np.int64), 0)
        _, index, n = np.unique(shell, return_inverse=True, return_counts=True)
        return cls(q, index, n.astype(np.float64), np.zeros(q.size), np.zeros(n.size), [])

    def sum(self, values: FloatArray) -> FloatArray:
        """Sum over the vectors of each shell."""
        return np.asarray(np.bincount(self.index, weights=values), dtype=np.float64)

    def add(self, power: FloatArray) -> None:
        """Take in the powers of the next frame."""
        self.total += power
        self.squares += self.sum(power**2)
        self.means.append(self.sum(power) / self.n)

    def standard_error(self) -> FloatArray:
        """Spread of the time averages over the vectors, about a straight line in q.

        Each shell has a line of its own: how S(q) changes within the shell is no error.
        """
        power = self.total / len(self.means)
        away = self.q - (self.sum(self.q) / self.n)[self.index]
        rest = power - (self.sum(power) / self.n)[self.index]
        width = self.sum(away**2)
        sloped = width > 1e-18 * self.sum(self.q**2)
        with np.errstate(divide="ignore", invalid="ignore"):
            slope = np.where(sloped, self.sum(away * rest) / width, 0.0)
            free = self.n - 1 - sloped
            squares = self.sum((rest - slope[self.index] * away) ** 2)
            return np.where(free >= 1, np.sqrt(squares / np.maximum(free, 1) / self.n), np.nan)

    def coupling(self) -> FloatArray:
        """Vectors that count as one, at least 1: how much the vectors of a shell vary together.

        The mean square of the frames over that of the rest, in the table of vectors and frames
        of a shell: 1 when the vectors vary independently, 1 + (n - 1) c when each two of the n
        have the correlation c.
        """
        frames, n = len(self.means), self.n
        mean = self.sum(self.total) / frames / n
        of_vectors = frames * self.sum((self.total / frames - mean[self.index]) ** 2)
        of_frames = n * np.sum((np.array(self.means) - mean) ** 2, axis=0)
        rest = self.squares - n * frames * mean**2 - of_vectors - of_frames
        known = (n > 1) & (rest > 1e-9 * self.squares) & (frames > 1)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(known, np.maximum((n - 1) * of_frames / rest, 1.0), 1.0)


def _summarise(shells: _Shells, scale: float) -> StructureFactor:
    n, coupling = shells.n, shells.coupling()
    power = shells.total / len(shells.means)
    value, mean_q = shells.sum(power) / n, shells.sum(shells.q) / n
    error = shells.standard_error() * np.sqrt(coupling)
    table = pd.DataFrame(
        {
            "wave_number": mean_q,
            "value": value,
            "std_error": error,
            "n_vectors": n.astype(np.int64),
            "n_independent": n / coupling,
        }
    )
    sums, counts = np.zeros((_GROUPS, n.size)), np.zeros((_GROUPS, n.size))
    group = np.arange(power.size) % _GROUPS
    np.add.at(counts, (group, shells.index), 1.0)
    np.add.at(sums, (group, shells.index), power)
    peak = _first_peak(mean_q, value, error, sums, counts, scale)
    if peak.get("q_peak_std_error") is not None:
        widen = float(np.sqrt(np.interp(peak["q_peak"], mean_q, coupling)))
        peak["q_peak_std_error"] *= widen
        peak["height_std_error"] *= widen
    return StructureFactor(table, peak)


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

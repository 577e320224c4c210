"""Compiled sums over all pairs of points of a track that are a given lag apart.

Every kernel writes one row per track (or per lag), so the result does not depend on the number
of threads. Reassociation is allowed where it lets the sums vectorise; missing points are flagged
by ``valid``, never by NaN.
"""

from typing import Any

import numpy as np
from numba import njit, prange
from scipy.special import factorial, jv

from cellquant.observables.trajectories import BoolArray, FloatArray, IntArray, Trajectories

_FAST = {"contract", "reassoc", "nsz"}

# J0(sqrt(u)) is entire in u: seven terms around nodes one apart reach 2e-14 up to u = 1024, and
# Hankel's expansion takes over there (x = 32).
_J0_NODES = 1025
_J0_TERMS = 8


def _bessel_table() -> FloatArray:
    """Taylor coefficients of J0(sqrt(u)) at u = 0, 1, ... : (-1/2)^k J_k(x) / (x^k k!)."""
    x = np.sqrt(np.arange(_J0_NODES, dtype=np.float64))
    table = np.empty((_J0_NODES, _J0_TERMS))
    for k in range(_J0_TERMS):
        table[1:, k] = (-0.5) ** k * jv(k, x[1:]) / (x[1:] ** k * factorial(k))
        table[0, k] = (-0.25) ** k / factorial(k) ** 2
    return table


_J0_TABLE = _bessel_table()


@njit(cache=True, fastmath=_FAST, inline="always")
def _j0_of_square(u: float, table: Any) -> float:
    """J0(sqrt(u)) for u >= 0."""
    if u < 1024.0:
        node = int(u + 0.5)
        t = u - node
        c = table[node]
        return float(
            c[0]
            + t * (c[1] + t * (c[2] + t * (c[3] + t * (c[4] + t * (c[5] + t * (c[6] + t * c[7]))))))
        )
    # Hankel's series: the k-th term is ((2k - 1)!!)^2 / (k! (8x)^k); at x = 32 twelve suffice.
    x = np.sqrt(u)
    w = 0.125 / x
    p, s, term = 1.0, 0.0, 1.0
    for k in range(1, 7):
        odd = (4 * k - 3) * (4 * k - 3) / (2 * k - 1) * w
        term *= odd
        s += -term if k % 2 == 1 else term
        term *= (4 * k - 1) * (4 * k - 1) / (2 * k) * w
        p += -term if k % 2 == 1 else term
    angle = x - 0.7853981633974483
    return float(np.sqrt(0.6366197723675814 / x) * (p * np.cos(angle) - s * np.sin(angle)))


@njit(cache=True, fastmath=_FAST)
def bessel_j0(x: FloatArray, table: FloatArray) -> FloatArray:  # pragma: no cover - compiled
    out = np.empty_like(x)
    for i in range(x.size):
        out[i] = _j0_of_square(x[i] * x[i], table)
    return out


@njit(cache=True, parallel=True, fastmath=_FAST)
def _pair_counts(
    valid: BoolArray, offsets: IntArray, lags: IntArray, stride: int, out: FloatArray
) -> None:
    for k in prange(offsets.size - 1):
        a, length = offsets[k], offsets[k + 1] - offsets[k]
        whole = stride == 1 and np.all(valid[a : a + length])
        for m in range(lags.size):
            lag = lags[m]
            if whole:
                out[k, m] = max(length - lag, 0)
                continue
            n = 0
            for i in range(0, length - lag, stride):
                n += valid[a + i] & valid[a + i + lag]
            out[k, m] = n


@njit(cache=True, parallel=True, fastmath=_FAST)
def _moments(
    x: FloatArray,
    y: FloatArray,
    valid: BoolArray,
    offsets: IntArray,
    lags: IntArray,
    stride: int,
    second: FloatArray,
    fourth: FloatArray,
) -> None:
    for k in prange(offsets.size - 1):
        a, length = offsets[k], offsets[k + 1] - offsets[k]
        xs, ys, ok = x[a : a + length], y[a : a + length], valid[a : a + length]
        whole = stride == 1 and np.all(ok)
        for m in range(lags.size):
            lag = lags[m]
            n = max(length - lag, 0)
            # Slices, not xs[i + lag]: without an index that could wrap around, the loop
            # vectorises (measured: four times faster).
            x0, y0, ok0 = xs[:n], ys[:n], ok[:n]
            x1, y1, ok1 = xs[lag:], ys[lag:], ok[lag:]
            s2, s4 = 0.0, 0.0
            if whole:
                for i in range(n):
                    dx, dy = x1[i] - x0[i], y1[i] - y0[i]
                    r2 = dx * dx + dy * dy
                    s2 += r2
                    s4 += r2 * r2
            else:
                for i in range(0, n, stride):
                    if ok0[i] & ok1[i]:
                        dx, dy = x1[i] - x0[i], y1[i] - y0[i]
                        r2 = dx * dx + dy * dy
                        s2 += r2
                        s4 += r2 * r2
            second[k, m] = s2
            fourth[k, m] = s4


@njit(cache=True, parallel=True, fastmath=_FAST)
def _scattering_bessel(
    x: FloatArray,
    y: FloatArray,
    valid: BoolArray,
    offsets: IntArray,
    lags: IntArray,
    stride: int,
    q: FloatArray,
    table: FloatArray,
    out: FloatArray,
) -> None:
    for k in prange(offsets.size - 1):
        a, length = offsets[k], offsets[k + 1] - offsets[k]
        xs, ys, ok = x[a : a + length], y[a : a + length], valid[a : a + length]
        for m in range(lags.size):
            lag = lags[m]
            for w in range(q.size):
                q2 = q[w] * q[w]
                total = 0.0
                for i in range(0, length - lag, stride):
                    if ok[i] & ok[i + lag]:
                        dx, dy = xs[i + lag] - xs[i], ys[i + lag] - ys[i]
                        total += _j0_of_square(q2 * (dx * dx + dy * dy), table)
                out[w, k, m] = total


@njit(cache=True, fastmath={"contract"}, forceinline=True)
def _cos_sin(phase: FloatArray, ok: BoolArray, c: FloatArray, s: FloatArray) -> None:
    """Cosine and sine of every phase, 0 where there is none.

    One reduction by pi/2 in three parts and two polynomials, without a branch, so that the loop
    vectorises; for |phase| < 1e5 the error stays below 4e-16 beside the rounding of the phase.
    """
    for i in range(phase.size):
        v = phase[i]
        n = np.floor(v * 0.6366197723675814 + 0.5)
        r = ((v - n * 1.5707963267341256) - n * 6.077100506303966e-11) - n * 2.0222662487959506e-21
        z = r * r
        sin_r = r + r * z * (
            -1.66666666666666324348e-01
            + z
            * (
                8.33333333332248946124e-03
                + z
                * (
                    -1.98412698298579493134e-04
                    + z
                    * (
                        2.75573137070700676789e-06
                        + z * (-2.50507602534068634195e-08 + z * 1.58969099521155010221e-10)
                    )
                )
            )
        )
        cos_r = (
            1.0
            - 0.5 * z
            + z
            * z
            * (
                4.16666666666666019037e-02
                + z
                * (
                    -1.38888888888741095749e-03
                    + z
                    * (
                        2.48015872894767294178e-05
                        + z
                        * (
                            -2.75573143513906633035e-07
                            + z * (2.08757232129817482790e-09 - z * 1.13596475577881948265e-11)
                        )
                    )
                )
            )
        )
        quadrant = n - 4.0 * np.floor(0.25 * n)
        odd = (quadrant == 1.0) | (quadrant == 3.0)
        cos_v = sin_r if odd else cos_r
        sin_v = cos_r if odd else sin_r
        cos_v = -cos_v if (quadrant == 1.0) | (quadrant == 2.0) else cos_v
        sin_v = -sin_v if quadrant >= 2.0 else sin_v
        c[i] = cos_v if ok[i] else 0.0
        s[i] = sin_v if ok[i] else 0.0


@njit(cache=True, parallel=True, fastmath=_FAST)
def _scattering_vectors(
    x: FloatArray,
    y: FloatArray,
    valid: BoolArray,
    offsets: IntArray,
    lags: IntArray,
    stride: int,
    vectors: FloatArray,
    longest: int,
    out: FloatArray,
) -> None:
    for k in prange(offsets.size - 1):
        a, length = offsets[k], offsets[k + 1] - offsets[k]
        ok = valid[a : a + length]
        phase = np.empty(longest)[:length]
        c, s = np.empty(longest)[:length], np.empty(longest)[:length]
        for w in range(vectors.shape[0]):
            qx, qy = vectors[w, 0], vectors[w, 1]
            for i in range(length):
                phase[i] = qx * x[a + i] + qy * y[a + i]
            _cos_sin(phase, ok, c, s)
            for m in range(lags.size):
                lag = lags[m]
                n = max(length - lag, 0)
                c0, s0, c1, s1 = c[:n], s[:n], c[lag:], s[lag:]
                total = 0.0
                if stride == 1:
                    for i in range(n):
                        total += c0[i] * c1[i] + s0[i] * s1[i]
                else:
                    for i in range(0, n, stride):
                        total += c0[i] * c1[i] + s0[i] * s1[i]
                out[w, k, m] = total


@njit(cache=True, parallel=True, fastmath=_FAST)
def _overlap_series(
    x: FloatArray,
    y: FloatArray,
    valid: BoolArray,
    offsets: IntArray,
    first_frame: IntArray,
    lags: IntArray,
    cutoff: float,
    inside: FloatArray,
    pairs: FloatArray,
    by_track: FloatArray,
) -> None:
    limit = cutoff * cutoff
    for m in prange(lags.size):
        lag = lags[m]
        for k in range(offsets.size - 1):
            a, length, t0 = offsets[k], offsets[k + 1] - offsets[k], first_frame[k]
            track_total = 0.0
            for i in range(length - lag):
                if valid[a + i] & valid[a + i + lag]:
                    dx, dy = x[a + i + lag] - x[a + i], y[a + i + lag] - y[a + i]
                    near = 1.0 if dx * dx + dy * dy <= limit else 0.0
                    inside[m, t0 + i] += near
                    pairs[m, t0 + i] += 1.0
                    track_total += near
            by_track[m, k] = track_total


def pair_counts(paths: Trajectories, lags: IntArray, *, stride: int = 1) -> FloatArray:
    """Number of pairs of points per track and lag, (n_tracks, n_lags)."""
    out = np.zeros((paths.n_tracks, lags.size))
    _pair_counts(paths.valid, paths.offsets, lags, stride, out)
    return out


def moments(
    paths: Trajectories, lags: IntArray, *, stride: int = 1
) -> tuple[FloatArray, FloatArray]:
    """Sums of the second and fourth power of the displacement, each (n_tracks, n_lags)."""
    second = np.zeros((paths.n_tracks, lags.size))
    fourth = np.zeros_like(second)
    _moments(paths.x, paths.y, paths.valid, paths.offsets, lags, stride, second, fourth)
    return second, fourth


def scattering_bessel(
    paths: Trajectories, lags: IntArray, q: FloatArray, *, stride: int = 1
) -> FloatArray:
    """Sums of J0(q r) over pairs, (n_q, n_tracks, n_lags)."""
    out = np.zeros((q.size, paths.n_tracks, lags.size))
    _scattering_bessel(
        paths.x, paths.y, paths.valid, paths.offsets, lags, stride, q, _J0_TABLE, out
    )
    return out


def scattering_vectors(
    paths: Trajectories, lags: IntArray, vectors: FloatArray, *, stride: int = 1
) -> FloatArray:
    """Sums of cos(q . dr) over pairs, (n_vectors, n_tracks, n_lags)."""
    out = np.zeros((vectors.shape[0], paths.n_tracks, lags.size))
    longest = int(np.max(np.diff(paths.offsets), initial=0))
    _scattering_vectors(
        paths.x,
        paths.y,
        paths.valid,
        paths.offsets,
        lags,
        stride,
        np.ascontiguousarray(vectors),
        longest,
        out,
    )
    return out


def overlap_series(
    paths: Trajectories, lags: IntArray, cutoff: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Pairs with displacement <= cutoff and all pairs, per lag and time origin; and per track.

    Returns
    -------
    inside, pairs : numpy.ndarray
        (n_lags, n_frames).
    by_track : numpy.ndarray
        (n_tracks, n_lags) number inside.
    """
    inside = np.zeros((lags.size, paths.n_frames))
    pairs = np.zeros_like(inside)
    by_track = np.zeros((lags.size, paths.n_tracks))
    _overlap_series(
        paths.x,
        paths.y,
        paths.valid,
        paths.offsets,
        paths.first_frame,
        lags,
        cutoff,
        inside,
        pairs,
        by_track,
    )
    return inside, pairs, np.ascontiguousarray(by_track.T)


@njit(cache=True, parallel=True)
def _add_waves(
    q_x: FloatArray, x: FloatArray, real_y: FloatArray, imag_y: FloatArray, out: Any
) -> None:
    for a in prange(q_x.size):
        for j in range(x.size):
            c, s = np.cos(q_x[a] * x[j]), np.sin(q_x[a] * x[j])
            for b in range(real_y.shape[1]):
                out[0, a, b] += c * real_y[j, b] - s * imag_y[j, b]
                out[1, a, b] += c * imag_y[j, b] + s * real_y[j, b]


def waves(q_x: FloatArray, q_y: FloatArray, place: FloatArray) -> FloatArray:
    """(2, n_x, n_y) real and imaginary part of ``sum_j exp(i q . r_j)`` on a grid of q.

    Cell after cell: the last digits of a matrix product depend on the number of threads.

    Parameters
    ----------
    q_x, q_y
        Wave numbers along the axes.
    place
        (n, 2) positions.
    """
    out = np.zeros((2, q_x.size, q_y.size))
    for start in range(0, len(place), 256):
        x, y = place[start : start + 256].T
        angle = np.outer(y, q_y)
        _add_waves(q_x, np.ascontiguousarray(x), np.cos(angle), np.sin(angle), out)
    return out

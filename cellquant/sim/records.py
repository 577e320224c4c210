"""Records: what every contact rule reads of a contour.

A row holds x, y, A0, an upper bound of rho, a lower estimate of rho, cos theta, sin theta, R0, then
the real and the imaginary parts of C_2 .. C_M (see `outlines`), A0 once more, and padding.
"""

import math
from typing import Any

from numba import njit

from cellquant.sim.gathers import gather, scatter
from cellquant.sim.lanes import (
    QUAD,
    choose,
    doubles,
    floor,
    load,
    root,
    store,
)

QUARTER_TURN, REST_OF_IT = 0.5 * math.pi, 6.123233995736766e-17
HEAD = 8  # entries of a record before the modes
FLAGS = {"contract", "nsz", "arcp", "reassoc"}


def record_length(n_modes: int) -> int:
    """Entries of a record, padded so that the modes are read four at a time."""
    return HEAD + (2 * n_modes + QUAD) // QUAD * QUAD


@njit(cache=True, fastmath=FLAGS, error_model="numpy", inline="always")
def cosine_and_sine(angle: Any) -> tuple[Any, Any]:
    """Cosine and sine of a vector to round-off; NaN where it is not finite."""
    quarter = floor(angle * (2.0 / math.pi) + 0.5)
    x = (angle - quarter * QUARTER_TURN) - quarter * REST_OF_IT
    q = x * x
    s = 1 / 362880 + q * (-1 / 39916800 + q * (1 / 6227020800 + q * (-1 / 1307674368000)))
    s = x + x * q * (-1 / 6 + q * (1 / 120 + q * (-1 / 5040 + q * s)))
    c = 1 / 479001600 + q * (-1 / 87178291200 + q * (1 / 20922789888000))
    c = -1 / 720 + q * (1 / 40320 + q * (-1 / 3628800 + q * c))
    c = 1.0 + q * (-0.5 + q * (1 / 24 + q * c))
    place = quarter - 4.0 * floor(0.25 * quarter)
    odd = (place == 1.0) | (place == 3.0)
    cosine = choose(odd, s, c)
    sine = choose(odd, c, s)
    cosine = choose((place == 1.0) | (place == 2.0), -cosine, cosine)
    return cosine, choose(place >= 2.0, -sine, sine)


@njit(cache=True, fastmath=FLAGS, error_model="numpy", inline="always")
def write_records(
    state: Any, radius: Any, begin: int, end: int, modes: Any, record: Any, places: Any,
    columns: Any,
) -> None:  # fmt: skip
    """Records of a tile of cells, with R0 sum n^2 |C_n| / R0 in place of the largest radius.

    A0 is that of the closed form, NaN where it has none; the lower estimate of rho is NaN.
    """
    n_modes = len(modes)
    n_columns = state.shape[1]
    stride = record.shape[1]
    for r in range(QUAD):
        places[r] = n_columns * min(begin + r, end - 1)
    x, y, theta, _ = gather(state, places, 0, 0)
    raw = (4 + 2 * n_modes) * QUAD
    for m in range(0, 2 * n_modes, 4):
        first = min(3 + m, n_columns - 4)
        v0, v1, v2, v3 = gather(state, places, 0, first)
        at = raw + (first + 1) * QUAD
        store(columns, at, v0)
        store(columns, at + QUAD, v1)
        store(columns, at + 2 * QUAD, v2)
        store(columns, at + 3 * QUAD, v3)
    for r in range(QUAD):
        columns[r] = radius[min(begin + r, end - 1)]
    r0 = load(columns, 0)
    cos_1, sin_1 = cosine_and_sine(theta)
    for m in range(2 * n_modes + 1, 2 * n_modes + 4):
        store(columns, m * QUAD, doubles(0.0))  # the padding of a record
    cos_n = cos_1
    sin_n = sin_1
    power = doubles(0.0)
    bend = doubles(0.0)
    for m in range(n_modes):
        cos_n, sin_n = cos_n * cos_1 - sin_n * sin_1, sin_n * cos_1 + cos_n * sin_1
        a = load(columns, raw + (4 + m) * QUAD)
        b = load(columns, raw + (4 + n_modes + m) * QUAD)
        square = a * a + b * b
        power += square
        bend += (m + 2.0) * (m + 2.0) * root(square)
        store(columns, m * QUAD, r0 * (a * cos_n - b * sin_n))
        store(columns, (n_modes + m) * QUAD, -r0 * (b * cos_n + a * sin_n))
    none = doubles(math.nan)
    fine = (power < 2.0) & (cos_1 * cos_1 < 2.0)
    mean = choose(fine, r0 * root(1.0 - 0.5 * power), none)
    store(columns, 2 * n_modes * QUAD, mean)
    # Lanes beyond the last cell write to the spare rows of the record.
    scatter(record, begin * stride, stride, x, y, mean, r0 * bend)
    scatter(record, begin * stride + 4, stride, none, cos_1, sin_1, r0)
    for m in range(0, 2 * n_modes + 1, 4):
        scatter(
            record, begin * stride + HEAD + m, stride, load(columns, m * QUAD),
            load(columns, (m + 1) * QUAD), load(columns, (m + 2) * QUAD),
            load(columns, (m + 3) * QUAD),
        )  # fmt: skip

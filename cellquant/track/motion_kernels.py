"""Compiled loops over steps: how cells and their neighbours moved, and what a link is worth."""

from typing import Any

import numpy as np
from numba import njit

FloatArray = np.ndarray[Any, np.dtype[np.float64]]
SingleArray = np.ndarray[Any, np.dtype[np.float32]]
IntArray = np.ndarray[Any, np.dtype[np.int64]]
BoolArray = np.ndarray[Any, np.dtype[np.bool_]]


@njit(cache=True, fastmath={"contract"}, forceinline=True)
def decay(x: FloatArray) -> None:
    """Replace x (L,) <= 0 by exp(x), to 1e-8 of it; by 0 below -12.

    Seven terms of the series of exp(x / 64), squared six times: without a branch, so that several
    are computed at once.
    """
    for q in range(len(x)):
        y = x[q] / 64.0
        series = 1.0 / 120.0 + y * (1.0 / 720.0 + y / 5040.0)
        series = 1.0 + y * (1.0 + y * (1.0 / 2.0 + y * (1.0 / 6.0 + y * (1.0 / 24.0 + y * series))))
        for _ in range(6):
            series *= series
        x[q] = series if x[q] > -12.0 else 0.0


@njit(cache=True)
def soft_flow(
    here: FloatArray,
    there: FloatArray,
    candidates: IntArray,
    neighbours: IntArray,
    flow: FloatArray,
    widths: FloatArray,
    rounds: IntArray,
    outlier: float,
    voice: FloatArray,
) -> float:
    """Move `flow` (n, 2) onto the next frame by soft assignment with shrinking width.

    Each cell spreads its weight over the candidates as ``exp(-d^2 / 2 width^2)``, divided by what
    competes for the same cell in either frame; its mean displacement, which counts as much as its
    `voice` (n,), is then averaged over its neighbours. Returns the mean weight that found a
    partner.
    """
    n, k = candidates.shape
    weight, way_x, way_y = np.empty((n, k)), np.empty((n, k)), np.empty((n, k))
    for i in range(n):
        for c in range(k):
            j = candidates[i, c]
            way_x[i, c], way_y[i, c] = there[j, 0] - here[i, 0], there[j, 1] - here[i, 1]
    column = np.zeros(len(there))
    row = np.zeros(n)
    moved = np.zeros((n, 3))
    averaged = np.zeros((n, 3))
    matched = 0.0
    for step in range(len(widths)):
        scale = -0.5 / widths[step] ** 2
        for i in range(n):
            x, y = flow[i, 0], flow[i, 1]
            for c in range(k):
                weight[i, c] = scale * ((way_x[i, c] - x) ** 2 + (way_y[i, c] - y) ** 2)
        decay(weight.reshape(n * k))
        column[:] = 0.0
        for i in range(n):
            total = 0.0
            for c in range(k):
                total += weight[i, c]
                column[candidates[i, c]] += weight[i, c]
            row[i] = total
        matched = 0.0
        for i in range(n):
            mx = my = mass = 0.0
            for c in range(k):
                w = weight[i, c] / (outlier + max(row[i], column[candidates[i, c]]))
                mass += w
                mx += w * way_x[i, c]
                my += w * way_y[i, c]
            moved[i, 0], moved[i, 1], moved[i, 2] = voice[i] * mx, voice[i] * my, voice[i] * mass
            matched += mass
        for _ in range(rounds[step]):
            for i in range(n):
                mx, my, mass = moved[i]
                for c in range(neighbours.shape[1]):
                    j = neighbours[i, c]
                    mx += moved[j, 0]
                    my += moved[j, 1]
                    mass += moved[j, 2]
                averaged[i, 0], averaged[i, 1], averaged[i, 2] = mx, my, mass
            moved, averaged = averaged, moved
        for i in range(n):
            if moved[i, 2] > 1e-9:
                flow[i, 0] = moved[i, 0] / moved[i, 2]
                flow[i, 1] = moved[i, 1] / moved[i, 2]
    return float(matched / max(n, 1))


@njit(cache=True)
def link_steps(
    position: FloatArray,
    start: IntArray,
    elapsed: FloatArray,
    after: IntArray,
    second: IntArray,
    confidence: FloatArray,
    flow: FloatArray,
    drift: FloatArray,
    own_after: FloatArray,
    own_before: FloatArray,
    has_after: IntArray,
    has_before: IntArray,
    left: FloatArray,
    arrived: FloatArray,
) -> None:
    """Displacements per frame along links, relative to the median of their frame.

    Writes drift (P, 2), own_after and own_before (N, 2) with has_after, has_before (N,), and the
    confidence of the link that leaves and of the one that arrives (N,); all zero where no single
    link is. The median is that of the flow where fewer than three links are trusted.
    """
    for p in range(len(start) - 2):
        first, n = start[p], start[p + 1] - start[p]
        steps = np.empty((2, n))
        trusted = 0
        for i in range(first, first + n):
            j = after[i]
            if j < 0 or second[i] >= 0:
                continue
            for d in range(2):
                own_after[i, d] = (position[j, d] - position[i, d]) / elapsed[i]
            left[i] = arrived[j] = confidence[j]
            has_after[i] = has_before[j] = 1
            if confidence[j] > 0.3:
                steps[0, trusted], steps[1, trusted] = own_after[i]
                trusted += 1
        for d in range(2):
            if trusted >= 3:
                drift[p, d] = np.median(steps[d, :trusted])
            elif n > 0:
                drift[p, d] = np.median(flow[first : first + n, d])
        for i in range(first, first + n):
            if has_after[i]:
                for d in range(2):
                    own_after[i, d] -= drift[p, d]
                    own_before[after[i], d] = own_after[i, d]


@njit(cache=True)
def squared_residuals(
    x: FloatArray, y: FloatArray, coefficient: FloatArray, out: FloatArray
) -> None:
    """Squared length, out (L,), of y (2 L,) less x (2 L, T) times its coefficients (T,).

    Two rows that follow each other are the components of one step.
    """
    for link in range(len(out)):
        total = 0.0
        for row in range(2 * link, 2 * link + 2):
            rest = y[row]
            for term in range(x.shape[1]):
                rest -= x[row, term] * coefficient[term]
            total += rest * rest
        out[link] = total


@njit(cache=True)
def add_weighted(
    x: FloatArray, y: FloatArray, weight: FloatArray, normal: FloatArray, right: FloatArray
) -> None:
    """Add x^T W x to normal (T, T) and x^T W y to right (T,), see `squared_residuals`."""
    terms = x.shape[1]
    lower = np.zeros((terms, terms))
    for row in range(len(y)):
        for term in range(terms):
            value = weight[row // 2] * x[row, term]
            right[term] += value * y[row]
            for other in range(term + 1):
                lower[term, other] += value * x[row, other]
    for term in range(terms):
        for other in range(term + 1):
            normal[term, other] += lower[term, other]
            if other < term:
                normal[other, term] += lower[term, other]


@njit(cache=True)
def neighbour_mean(
    displacement: FloatArray,
    weight: FloatArray,
    neighbours: IntArray,
    near: int,
    field: FloatArray,
    shift: FloatArray,
    frame: IntArray,
    prior: float,
    out: FloatArray,
) -> None:
    """Weighted mean displacement of the neighbours at two scales, out (N, 2, 2).

    Each mean carries `prior` weight of the field less the shift of the frame, which alone decides
    where no neighbour has a displacement.
    """
    n, m = neighbours.shape
    for i in range(n):
        x = y = 0.0
        mass = 0.0
        fx, fy = field[i, 0] - shift[frame[i], 0], field[i, 1] - shift[frame[i], 1]
        for scale in range(2):
            first = 0 if scale == 0 else near
            last = near if scale == 0 else m
            for c in range(first, last):
                j = neighbours[i, c]
                if j == i:
                    continue
                w = weight[j]
                mass += w
                x += w * displacement[j, 0]
                y += w * displacement[j, 1]
            out[i, scale, 0] = (x + prior * fx) / (mass + prior)
            out[i, scale, 1] = (y + prior * fy) / (mass + prior)


@njit(cache=True)
def steps_ahead(
    around_after: FloatArray,
    around_before: FloatArray,
    own_before: FloatArray,
    has_before: IntArray,
    drift: FloatArray,
    frame: IntArray,
    elapsed: FloatArray,
    coefficients: FloatArray,
    own_path: bool,
    out: FloatArray,
) -> None:
    """Expected displacements, out (N, 2), of cells whose partners are not known.

    What the partner's neighbourhood does now is what the own neighbourhood does now.
    """
    for i in range(len(out)):
        b = coefficients[2 * has_before[i] if own_path else 0]
        for d in range(2):
            step = (b[0] + b[3]) * around_after[i, 0, d] + b[1] * around_after[i, 1, d]
            step += b[2] * around_before[i, 0, d] + b[5] * own_before[i, d]
            out[i, d] = (drift[frame[i], d] + step) * elapsed[i]


@njit(cache=True)
def step_ratios(
    position: FloatArray,
    candidates: IntArray,
    elapsed: FloatArray,
    spread: FloatArray,
    own_before: FloatArray,
    own_after: FloatArray,
    has_before: IntArray,
    has_after: IntArray,
    around_after: FloatArray,
    around_before: FloatArray,
    drift: FloatArray,
    frame: IntArray,
    coefficients: FloatArray,
    scale: FloatArray,
    tail: FloatArray,
    slivers: BoolArray,
    sliver_tail: float,
    max_distance: float,
    out: SingleArray,
) -> None:
    """How far each candidate lies from the predicted step: ``1 + r^2 / (width^2 nu)``, (N, K).

    That is what the Student density of the residual r falls with; infinite where there is no
    candidate, or none within the largest distance. See `pair_gains`.
    """
    n, k = candidates.shape
    # What partners bring to the prediction, for cells without and with a step before.
    partner = np.empty((n, 2, 2))
    for j in range(n):
        for before in range(2):
            b = coefficients[2 * before + has_after[j]]
            for d in range(2):
                value = b[3] * around_before[j, 0, d] + b[4] * around_after[j, 0, d]
                if has_after[j]:
                    value += b[6] * own_after[j, d]
                partner[j, before, d] = value
    ahead, inverse = np.empty((2, 2)), np.empty(2)
    for i in range(n):
        before = has_before[i]
        for after in range(2):
            b = coefficients[2 * before + after]
            for d in range(2):
                value = drift[frame[i], d] + b[0] * around_after[i, 0, d]
                value += b[1] * around_after[i, 1, d] + b[2] * around_before[i, 0, d]
                if before:
                    value += b[5] * own_before[i, d]
                ahead[after, d] = value
            width = scale[2 * before + after] * spread[i]
            nu = sliver_tail if slivers[i] else tail[2 * before + after]
            inverse[after] = elapsed[i] ** 2 / (width * width * nu)
        for c in range(k):
            j = candidates[i, c]
            out[i, c] = np.inf
            if j < 0:
                continue
            dx = position[j, 0] - position[i, 0]
            dy = position[j, 1] - position[i, 1]
            if dx * dx + dy * dy > max_distance * max_distance:
                continue
            after = has_after[j]
            rx = dx / elapsed[i] - ahead[after, 0] - partner[j, before, 0]
            ry = dy / elapsed[i] - ahead[after, 1] - partner[j, before, 1]
            out[i, c] = 1.0 + (rx * rx + ry * ry) * inverse[after]


@njit(cache=True)
def pair_gains(
    log_ratio: SingleArray,
    cut: BoolArray,
    candidates: IntArray,
    spread: FloatArray,
    has_before: IntArray,
    has_after: IntArray,
    scale: FloatArray,
    tail: FloatArray,
    slivers: BoolArray,
    sliver_tail: float,
    shape_after: FloatArray,
    shape_expected: FloatArray,
    shape_spread: FloatArray,
    informative: FloatArray,
    unlike: FloatArray,
    shape_tail: float,
    stay: FloatArray,
    leave: FloatArray,
    appear: FloatArray,
    doubt: float,
    gain: FloatArray,
) -> None:
    """Log odds of every candidate link against death of one cell and birth of the other.

    gain (N, K); candidates (N, K) with -1 where there is none; log_ratio (N, K) the logarithm of
    `step_ratios`. The residual of the displacement from its prediction has a two-dimensional
    Student density, of slivers (N,) with a tail of their own; so has the change of shape, against
    the density of shapes in the population, unless the edge of the view cuts one of them.
    shape_after and shape_expected (N, F) are each cell's descriptors, and those expected of its
    successor, in units of their scatter; unlike (N,) is the negative log density of each shape in
    the population, up to the constants of both densities. Shapes are compared where the best of
    them could bring a candidate within `doubt` of the likeliest of its cell.
    """
    n, k = candidates.shape
    f = shape_after.shape[1]
    half = (shape_tail + f) / 2
    height = -np.log(2 * np.pi * scale**2)
    step, power = np.empty(k), np.empty(2)
    for i in range(n):
        kind = 2 * has_before[i]
        for after in range(2):
            nu = sliver_tail if slivers[i] else tail[kind + after]
            power[after] = nu / 2 + 1
        wide = f * np.log(shape_spread[i])
        fate = stay[i] - leave[i] - 2.0 * np.log(spread[i])
        best, most = -1, -np.inf
        for c in range(k):
            j = candidates[i, c]
            step[c] = -np.inf
            if log_ratio[i, c] == np.inf:
                continue
            after = has_after[j]
            step[c] = height[kind + after] + fate - appear[j] - power[after] * log_ratio[i, c]
            if step[c] > most:
                best, most = c, step[c]
        # The likeliest by its step first: it says which of the others are in doubt.
        if best >= 0:
            least = -np.inf
            for turn in range(-1, k):
                c = best if turn < 0 else turn
                j = candidates[i, c]
                if (turn >= 0 and c == best) or j < 0:
                    continue
                if cut[i] or cut[j]:
                    least = max(least, step[c] - doubt)
                    continue
                if step[c] + unlike[j] - wide < least:
                    continue
                near = 0.0
                for d in range(f):
                    near += (shape_after[j, d] - shape_expected[i, d]) ** 2
                near /= shape_spread[i] ** 2 * shape_tail
                odds = unlike[j] - wide - half * np.log(1.0 + near)
                if informative[i] < 1.0:
                    odds = np.log(1.0 - informative[i] + informative[i] * np.exp(odds))
                step[c] += odds
                least = max(least, step[c] - doubt)
        for c in range(k):
            gain[i, c] = step[c]

"""Compiled loops of the tracker; they inline each other and stay in one file."""

from typing import Any

import numpy as np
from numba import njit

FloatArray = np.ndarray[Any, np.dtype[np.float64]]
IntArray = np.ndarray[Any, np.dtype[np.int64]]
BoolArray = np.ndarray[Any, np.dtype[np.bool_]]


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
    weight = np.zeros((n, k))
    column = np.zeros(len(there))
    row = np.zeros(n)
    moved = np.zeros((n, 3))
    averaged = np.zeros((n, 3))
    matched = 0.0
    for step in range(len(widths)):
        scale = -0.5 / widths[step] ** 2
        column[:] = 0.0
        row[:] = 0.0
        for i in range(n):
            for c in range(k):
                j = candidates[i, c]
                dx = there[j, 0] - here[i, 0] - flow[i, 0]
                dy = there[j, 1] - here[i, 1] - flow[i, 1]
                exponent = scale * (dx * dx + dy * dy)
                w = np.exp(exponent) if exponent > -12.0 else 0.0
                weight[i, c] = w
                row[i] += w
                column[j] += w
        matched = 0.0
        for i in range(n):
            mx = my = mass = 0.0
            for c in range(k):
                if weight[i, c] == 0.0:
                    continue
                j = candidates[i, c]
                w = weight[i, c] / (outlier + max(row[i], column[j]))
                mass += w
                mx += w * (there[j, 0] - here[i, 0])
                my += w * (there[j, 1] - here[i, 1])
            for d, value in enumerate((mx, my, mass)):
                moved[i, d] = voice[i] * value
            matched += mass
        for _ in range(rounds[step]):
            for i in range(n):
                for d in range(3):
                    averaged[i, d] = moved[i, d]
                for c in range(neighbours.shape[1]):
                    j = neighbours[i, c]
                    for d in range(3):
                        averaged[i, d] += moved[j, d]
            moved, averaged = averaged, moved
        for i in range(n):
            if moved[i, 2] > 1e-9:
                flow[i, 0] = moved[i, 0] / moved[i, 2]
                flow[i, 1] = moved[i, 1] / moved[i, 2]
    return float(matched / max(n, 1))


@njit(cache=True)
def widest_gaps(position: FloatArray, neighbours: IntArray, out: FloatArray) -> None:
    """Widest angle out (N,) around each cell that holds none of its neighbours (N, K), K >= 1."""
    k = neighbours.shape[1]
    angle = np.empty(k)
    for i in range(len(position)):
        for c in range(k):
            j = neighbours[i, c]
            value = np.arctan2(position[j, 1] - position[i, 1], position[j, 0] - position[i, 0])
            place = c
            while place > 0 and angle[place - 1] > value:
                angle[place] = angle[place - 1]
                place -= 1
            angle[place] = value
        out[i] = angle[0] + 2.0 * np.pi - angle[k - 1]
        for c in range(1, k):
            out[i] = max(out[i], angle[c] - angle[c - 1])


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
def marginals(
    gain: FloatArray,
    candidates: IntArray,
    start: IntArray,
    rounds: int,
    least: float,
    certain: float,
    out: FloatArray,
) -> None:
    """Probability of every candidate link by belief propagation, out (N, K).

    ``exp(gain)`` is the odds of a link against neither cell having a partner; candidates below 0
    are none, and gains below `least` count as none. Candidates are cells of the next frame, frames
    begin at start (P + 1,). Exact where the candidate graph is a tree, and close to it elsewhere.
    A link whose log odds are above `certain` whatever its rivals do is not propagated, and they are
    dropped.
    """
    # Gains beyond this change no probability, but their sums would swallow the 1 of "no partner".
    limit = 25.0
    k = candidates.shape[1]
    most = 0
    for p in range(len(start) - 1):
        most = max(most, start[p + 1] - start[p])
    odds, from_row, from_column = np.empty(most * k), np.empty(most * k), np.empty(most * k)
    source, target = np.empty(most * k, dtype=np.int64), np.empty(most * k, dtype=np.int64)
    place = np.empty(most * k, dtype=np.int64)
    total_row, total_column = np.empty(most), np.empty(most)
    first_row, first_column = np.empty(most, dtype=np.int64), np.empty(most, dtype=np.int64)
    second_row, top_column, second_column = np.empty(most), np.empty(most), np.empty(most)
    rivals = np.empty(most, dtype=np.int64)
    closed_row, closed_column = np.empty(most, dtype=np.bool_), np.empty(most, dtype=np.bool_)
    out[:] = 0.0
    for p in range(len(start) - 2):
        first, n, there = start[p], start[p + 1] - start[p], start[p + 1]
        top_column[:] = -np.inf
        second_column[:] = -np.inf
        first_column[:] = -1
        rivals[:] = -1
        closed_row[:] = False
        closed_column[:] = False
        for i in range(n):
            best, top, second = -1, -np.inf, -np.inf
            for c in range(k):
                g, j = gain[first + i, c], candidates[first + i, c] - there
                if j < 0:
                    continue
                rivals[j] += 1
                if g > top:
                    best, top, second = c, g, top
                elif g > second:
                    second = g
                if g > top_column[j]:
                    top_column[j], second_column[j], first_column[j] = g, top_column[j], i
                elif g > second_column[j]:
                    second_column[j] = g
            first_row[i], second_row[i] = best, second
        # Where the rivals together cannot bring a link below certainty, they are out of question.
        for i in range(n):
            c = first_row[i]
            if c < 0 or gain[first + i, c] <= certain:
                continue
            j = candidates[first + i, c] - there
            if first_column[j] != i:
                continue
            g = gain[first + i, c]
            g -= np.log(1.0 + (k - 1) * np.exp(second_row[i]))
            g -= np.log(1.0 + rivals[j] * np.exp(second_column[j]))
            if g > certain:
                out[first + i, c] = 1.0 / (1.0 + np.exp(-g))
                closed_row[i] = closed_column[j] = True
        links = 0
        for i in range(n):
            if closed_row[i]:
                continue
            for c in range(k):
                g, j = gain[first + i, c], candidates[first + i, c] - there
                if j >= 0 and g >= least and not closed_column[j]:
                    source[links], target[links], place[links] = i, j, c
                    odds[links], from_column[links] = np.exp(min(g, limit)), 1.0
                    links += 1
        for _ in range(rounds):
            total_row[:] = 1.0
            total_column[:] = 1.0
            for q in range(links):
                total_row[source[q]] += odds[q] * from_column[q]
            for q in range(links):
                rest = total_row[source[q]] - odds[q] * from_column[q]
                from_row[q] = 1.0 / max(rest, 1.0)
                total_column[target[q]] += odds[q] * from_row[q]
            for q in range(links):
                rest = total_column[target[q]] - odds[q] * from_row[q]
                from_column[q] = 1.0 / max(rest, 1.0)
        for q in range(links):
            belief = odds[q] * from_row[q] * from_column[q]
            out[first + source[q], place[q]] = belief / (1.0 + belief)


@njit(cache=True)
def pair_gains(
    position: FloatArray,
    cut: BoolArray,
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
    shape_after: FloatArray,
    shape_expected: FloatArray,
    shape_spread: FloatArray,
    informative: FloatArray,
    unlike: FloatArray,
    shape_tail: float,
    stay: FloatArray,
    leave: FloatArray,
    appear: FloatArray,
    max_distance: float,
    doubt: float,
    gain: FloatArray,
) -> None:
    """Log odds of every candidate link against death of one cell and birth of the other.

    gain (N, K); candidates (N, K) with -1 where there is none. The residual of the displacement
    from its prediction has a two-dimensional Student density, of slivers (N,) with a tail of their
    own; so has the change of shape, against the density of shapes in the population, unless the
    edge of the view cuts one of them. shape_after and shape_expected (N, F) are each cell's
    descriptors, and those expected of its successor, in units of their scatter; unlike (N,) is the
    negative log density of each shape in the population, up to the constants of both densities.
    Shapes are compared where the best of them could bring a candidate within `doubt` of the
    likeliest of its cell.
    """
    n, k = candidates.shape
    f = shape_after.shape[1]
    half = (shape_tail + f) / 2
    height = -np.log(2 * np.pi * scale**2)
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
    ahead, inverse, step = np.empty((2, 2)), np.empty(2), np.empty(k)
    power = np.empty(2)
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
            power[after] = nu / 2 + 1
        wide = f * np.log(shape_spread[i])
        fate = stay[i] - leave[i] - 2.0 * np.log(spread[i])
        best, most = -1, -np.inf
        for c in range(k):
            j = candidates[i, c]
            step[c] = -np.inf
            if j < 0:
                continue
            dx = position[j, 0] - position[i, 0]
            dy = position[j, 1] - position[i, 1]
            if dx * dx + dy * dy > max_distance * max_distance:
                continue
            after = has_after[j]
            kind = 2 * before + after
            rx = dx / elapsed[i] - ahead[after, 0] - partner[j, before, 0]
            ry = dy / elapsed[i] - ahead[after, 1] - partner[j, before, 1]
            step[c] = height[kind] + fate - appear[j]
            step[c] -= power[after] * np.log(1.0 + (rx * rx + ry * ry) * inverse[after])
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


@njit(cache=True)
def division_gains(
    position: FloatArray,
    shape: FloatArray,
    cut: BoolArray,
    candidates: IntArray,
    orphan: BoolArray,
    middle: FloatArray,
    width: FloatArray,
    tail: float,
    separation: FloatArray,
    ratios: FloatArray,
    population: FloatArray,
    stretch: FloatArray,
    prior: FloatArray,
    leave: FloatArray,
    appear: FloatArray,
    least: float,
    most: int,
    out_cells: IntArray,
    out_gain: FloatArray,
) -> int:
    """Log odds of divisions with at least one daughter that has no sure mother; their number.

    The middle of the daughters stays near the predicted place (Student density), their distance
    against their size is log-normal, and so are the sum of their areas against the mother's and
    their ratio, unless (with chance 1 - ratios[3]) their sizes tell nothing. Mother and daughters
    are elongated along their line by `stretch` (mother, daughters, any cell: mean, width along,
    width across; Student density). Each kind of family has such laws of its own, first axis of
    width, separation, ratios, stretch and prior. population (N,) is the log density of sizes at
    each cell. Writes (mother, daughter, daughter), at most `most` per mother, best first.
    """
    k = candidates.shape[1]
    nu = 5.0
    last = 0
    for i in range(len(candidates)):
        first = last
        for c in range(k):
            j = candidates[i, c]
            if j < 0 or not orphan[j]:
                continue
            for d in range(k):
                h = candidates[i, d]
                if h < 0 or h == j or (orphan[h] and h < j):
                    continue
                dx = position[h, 0] - position[j, 0]
                dy = position[h, 1] - position[j, 1]
                apart = np.sqrt(dx * dx + dy * dy)
                if apart <= 0.0:
                    continue
                mx = (position[h, 0] + position[j, 0]) / 2 - middle[i, 0]
                my = (position[h, 1] + position[j, 1]) / 2 - middle[i, 1]
                both = np.log(np.exp(shape[j, 0]) + np.exp(shape[h, 0]))
                # Elongation along and across the line between the daughters.
                along = (dx * dx - dy * dy) / (apart * apart)
                across = 2.0 * dx * dy / (apart * apart)
                at_edge = cut[i] or cut[j] or cut[h]
                size = max(both, shape[i, 0]) if at_edge else both
                value = -np.inf
                for m in range(len(prior)):
                    if at_edge != (m == 1):
                        continue
                    w = width[m, i]
                    one = prior[m, i] - np.log(2 * np.pi * w * w)
                    one -= (tail / 2 + 1) * np.log1p((mx * mx + my * my) / (w * w * tail))
                    z = (np.log(apart) - size / 2 - separation[m, 0]) / separation[m, 1]
                    one -= 0.5 * z * z + np.log(separation[m, 1] * np.sqrt(2 * np.pi))
                    r = ratios[m]
                    z = (both - shape[i, 0] - r[0]) / r[1]
                    sizes = -0.5 * z * z - np.log(2 * np.pi * r[1] * r[2])
                    z = (shape[j, 0] - shape[h, 0]) / r[2]
                    sizes -= 0.5 * z * z
                    sizes -= population[j] + population[h]
                    one += np.log(1.0 - r[3] + r[3] * np.exp(sizes))
                    for g, role in ((i, 0), (j, 1), (h, 1)):
                        if cut[g]:
                            continue
                        law, any_cell = stretch[m, role], stretch[m, 2, 1]
                        e = along * shape[g, 1] + across * shape[g, 2]
                        o = along * shape[g, 2] - across * shape[g, 1]
                        near = ((e - law[0]) / law[1]) ** 2 + (o / law[2]) ** 2
                        far = (e * e + o * o) / any_cell**2
                        one += (nu / 2 + 1) * (np.log1p(far / nu) - np.log1p(near / nu))
                        one += np.log(any_cell**2 / (law[1] * law[2]))
                    value = one if m < 2 else np.logaddexp(value, one)
                value -= np.log(2 * np.pi * apart * apart)
                value -= leave[i] + appear[j] + appear[h]
                if value <= least or (last - first == most and value <= out_gain[last - 1]):
                    continue
                place = last if last - first < most else last - 1
                last = place + 1
                while place > first and out_gain[place - 1] < value:
                    out_gain[place] = out_gain[place - 1]
                    out_cells[place] = out_cells[place - 1]
                    place -= 1
                out_gain[place] = value
                out_cells[place, 0], out_cells[place, 1], out_cells[place, 2] = i, j, h
    return last


@njit(cache=True)
def overlap_shares(
    here: IntArray,
    there: IntArray,
    label: IntArray,
    centre: FloatArray,
    half: FloatArray,
    shift: IntArray,
    targets: IntArray,
    stride: int,
    share: FloatArray,
) -> None:
    """Share (L, K) of each cell that falls on the labels `targets` after an integer shift.

    Only every `stride`-th row and column of the box ``centre +- half`` is visited; label 0 is no
    target.
    """
    height, width = here.shape
    for p in range(len(label)):
        top = max(int(centre[p, 1] - half[p]), 0)
        bottom = min(int(centre[p, 1] + half[p]) + 2, height)
        left = max(int(centre[p, 0] - half[p]), 0)
        right = min(int(centre[p, 0] + half[p]) + 2, width)
        size = 0
        share[p, :] = 0.0
        for y in range(top, bottom, stride):
            v = y + shift[p, 1]
            for x in range(left, right, stride):
                if here[y, x] != label[p]:
                    continue
                size += 1
                u = x + shift[p, 0]
                if u < 0 or v < 0 or u >= width or v >= height or there[v, u] == 0:
                    continue
                for c in range(targets.shape[1]):
                    if there[v, u] == targets[p, c]:
                        share[p, c] += 1.0
                        break
        for c in range(targets.shape[1]):
            share[p, c] = share[p, c] / size if size > 0 else np.nan


@njit(cache=True)
def patch_correlations(
    here: FloatArray,
    there: FloatArray,
    source: IntArray,
    target: IntArray,
    half: int,
    stride: int,
    correlation: FloatArray,
) -> None:
    """Normalised cross-correlation (L,) of square patches around pixels (L, 2) of two images.

    NaN where less than half of the patch lies inside both images or one of them is flat.
    """
    height, width = here.shape
    side = len(range(-half, half + 1, stride))
    for p in range(len(source)):
        n = 0
        sa = sb = saa = sbb = sab = 0.0
        for dy in range(-half, half + 1, stride):
            ya, yb = source[p, 1] + dy, target[p, 1] + dy
            if ya < 0 or yb < 0 or ya >= height or yb >= height:
                continue
            for dx in range(-half, half + 1, stride):
                xa, xb = source[p, 0] + dx, target[p, 0] + dx
                if xa < 0 or xb < 0 or xa >= width or xb >= width:
                    continue
                a, b = float(here[ya, xa]), float(there[yb, xb])
                n += 1
                sa += a
                sb += b
                saa += a * a
                sbb += b * b
                sab += a * b
        correlation[p] = np.nan
        if 2 * n >= side * side:
            va, vb = saa - sa * sa / n, sbb - sb * sb / n
            if va > 1e-9 * max(saa, 1e-300) and vb > 1e-9 * max(sbb, 1e-300):
                correlation[p] = (sab - sa * sb / n) / np.sqrt(va * vb)

"""Sub-pixel contours of labelled cells: area, perimeter, moments and neighbours.

A contour is followed along the cracks between the pixels of a cell and all others, the cell on
the right-hand side; everything is measured on that one closed path. Its length is that of a curve
through overlapping digital straight segments, which are long where the contour is straight and
short where it bends, so that nothing has to be known of the size of the cells. Where the label
beside the cell changes, the contour may have a corner: segments end there, and the length that
pixels miss at the tip is added. Of a cell that background lines cut out, the cells across the
lines are what it has beside it.

References
----------
Debled-Rennesson & Reveilles, Int. J. Pattern Recognition and Artificial Intelligence 9, 635
(1995), doi:10.1142/S0218001495000249: recognition of digital straight segments.
Lachaud, Vialard & de Vieilleville, Image and Vision Computing 25, 1572 (2007),
doi:10.1016/j.imavis.2006.06.019: averages over maximal segments.
"""

from typing import Any, NamedTuple

import numba as nb
import numpy as np

FloatArray = np.ndarray[Any, np.dtype[np.float64]]
IntArray = np.ndarray[Any, np.dtype[np.int64]]

NEIGHBOUR_GAP = 3
"""Pixels of background that may lie between two cells that count as neighbours."""

# A contour has a length from this area (px) and this extent along both axes (px) on.
_MIN_AREA = 10
_MIN_WIDTH = 2
# Cracks beside one other label that make an arc of its own.
_MIN_ARC = 3
# Cracks of the longest straight segment looked for; bounds the cost of long straight edges.
_MAX_SEGMENT = 100
# Largest turn at a junction, rad: a sharper tip has no finite mean loss.
_MAX_TURN = 2.6
# Length that straight segments fitted up to a corner add to it (px), at contacts and between two
# lines, where the place of the corner is less certain; and the turn from which on they do so in
# full (rad). Measured on Voronoi tissue at radii of 8 to 20 px.
_CORNER_GAIN = 0.05
_LINE_GAIN = 0.025
_FULL_TURN = np.pi / 3

# Share of the contour along lines from which on a cell counts as cut out by them.
_LINED = 0.5
# Pixels around a background pixel, nearest first, in which the cell across a line is looked for.
_AROUND = np.array(
    sorted(
        (x * x + y * y, x, y)
        for x in range(-NEIGHBOUR_GAP, NEIGHBOUR_GAP + 1)
        for y in range(-NEIGHBOUR_GAP, NEIGHBOUR_GAP + 1)
        if 0 < x * x + y * y <= NEIGHBOUR_GAP**2
    )
)

# Steps along a crack: right, down, left, up.
_DX = np.array([1, 0, -1, 0])
_DY = np.array([0, 1, 0, -1])


class Outlines(NamedTuple):
    """Measures of n cells in pixels; x to the right, y down, pixel centres at integers."""

    x: FloatArray
    y: FloatArray
    area: FloatArray
    perimeter: FloatArray
    aspect_ratio: FloatArray
    orientation: FloatArray
    touches_border: np.ndarray[Any, np.dtype[np.bool_]]
    n_neighbours: IntArray
    enclosed: np.ndarray[Any, np.dtype[np.bool_]]


def measure_outlines(
    labels: np.ndarray[Any, Any], row: IntArray, column: IntArray, *, gap: int = NEIGHBOUR_GAP
) -> Outlines:
    """Measure the cells whose first pixels in reading order are given.

    Parameters
    ----------
    labels
        (H, W) integer labels without parts that are left out.
    row, column
        (n,) first pixel of each cell.
    gap
        Largest number of background pixels between neighbours, in px.

    Returns
    -------
    Outlines
        perimeter is NaN where the contour is too coarse to have a length.
    """
    values, flags, n_neighbours = _measure(np.ascontiguousarray(labels), row, column, gap)
    return Outlines(
        x=values[:, 0],
        y=values[:, 1],
        area=values[:, 2],
        perimeter=values[:, 3],
        aspect_ratio=values[:, 4],
        orientation=values[:, 5],
        touches_border=flags[:, 0],
        n_neighbours=n_neighbours,
        enclosed=flags[:, 1],
    )


@nb.njit(cache=True)
def _trace(labels, row, column, steps, outside):  # type: ignore[no-untyped-def]
    """Follow the cracks around one cell; returns steps, label outside of each, and their number.

    Starts at the upper left corner of the first pixel. Pixels that touch by a corner belong
    together. Outside the image the label is -1.
    """
    height, width = labels.shape
    label = labels[row, column]
    x, y, step, n = column, row, 0, 0
    while True:
        if n == len(steps):
            longer_steps = np.empty(2 * n, np.int8)
            longer_steps[:n] = steps
            steps = longer_steps
            longer_outside = np.empty(2 * n, np.int64)
            longer_outside[:n] = outside
            outside = longer_outside
        # The pixel to the left of the crack from (x, y) in direction step.
        column_out = x - (1 if step == 2 or step == 3 else 0)
        row_out = y - (1 if step == 0 or step == 3 else 0)
        if 0 <= column_out < width and 0 <= row_out < height:
            outside[n] = labels[row_out, column_out]
        else:
            outside[n] = -1
        steps[n] = step
        n += 1
        x += _DX[step]
        y += _DY[step]
        # Turn left if the pixel ahead on the left is in, else go straight or turn right.
        left_x = x - (1 if step == 2 or step == 3 else 0)
        left_y = y - (1 if step == 0 or step == 3 else 0)
        right_x = x - (1 if step == 1 or step == 2 else 0)
        right_y = y - (1 if step == 2 or step == 3 else 0)
        if 0 <= left_x < width and 0 <= left_y < height and labels[left_y, left_x] == label:
            step = (step + 3) % 4
        elif not (
            0 <= right_x < width and 0 <= right_y < height and labels[right_y, right_x] == label
        ):
            step = (step + 1) % 4
        if x == column and y == row and step == 0:
            return steps, outside, n


@nb.njit(cache=True)
def _junctions(outside, n, junctions):  # type: ignore[no-untyped-def]
    """Cracks at which the contour passes from one neighbour (or background) to the next; count.

    A stretch beside one other label counts from `_MIN_ARC` cracks on. A shorter one between two
    stretches beside the same label belongs to them; between two different ones, the junction is
    put in its middle.
    """
    first = -1
    for i in range(n):
        if outside[i] != outside[i - 1 if i > 0 else n - 1]:
            first = i
            break
    if first < 0:
        return 0
    n_junctions = 0
    stop, label = -1, 0  # end and label of the last stretch that counts
    opening, opening_label = -1, 0  # start and label of the first one
    i = first
    while i < first + n:
        start = i
        beside = outside[i % n]
        while i < first + n and outside[i % n] == beside:
            i += 1
        if i - start < _MIN_ARC:
            continue
        if stop < 0:
            opening, opening_label = start, beside
        elif beside != label:
            junctions[n_junctions] = (stop + start) // 2
            n_junctions += 1
        stop, label = i, beside
    if stop >= 0 and label != opening_label:
        junctions[n_junctions] = (stop + opening + n) // 2
        n_junctions += 1
    return n_junctions


@nb.njit(cache=True)
def _nearest(labels, row, column, label, touching, n_touching):  # type: ignore[no-untyped-def]
    """Label nearest to a background pixel other than that of the cell; 0 where there is none.

    None, too, is what two labels at one distance are, and a cell that touches this one.
    """
    height, width = labels.shape
    nearest, reach = np.int64(0), 0
    for k in range(len(_AROUND)):
        if nearest != 0 and _AROUND[k, 0] > reach:
            break
        x, y = column + _AROUND[k, 1], row + _AROUND[k, 2]
        if not (0 <= x < width and 0 <= y < height):
            continue
        other = np.int64(labels[y, x])
        if other == 0 or other == label or other == nearest:  # noqa: SIM109
            continue
        if nearest != 0:
            return 0
        nearest, reach = other, _AROUND[k, 0]
    for k in range(n_touching):
        if touching[k] == nearest:
            return 0
    return nearest


@nb.njit(cache=True)
def _across_lines(  # type: ignore[no-untyped-def]
    labels, row, column, steps, outside, n, touching, n_touching, across
):
    """Cells across lines of background, crack by crack; 0 for none, -1 at a contact.

    Returns how many cracks have one.
    """
    label = np.int64(labels[row, column])
    x, y = column, row
    n_across = 0
    for i in range(n):
        step = steps[i]
        across[i] = -1
        if outside[i] == 0:
            column_out = x - (1 if step == 2 or step == 3 else 0)
            row_out = y - (1 if step == 0 or step == 3 else 0)
            across[i] = _nearest(labels, row_out, column_out, label, touching, n_touching)
            n_across += across[i] > 0
        x += _DX[step]
        y += _DY[step]
    return n_across


@nb.njit(cache=True)
def _line_junctions(across, n, junctions, n_junctions):  # type: ignore[no-untyped-def]
    """Add the cracks at which the contour passes from one cell across a line to the next.

    As in `_junctions` stretches shorter than `_MIN_ARC` do not count. Where open background or a
    contact lies between two cells, no corner is theirs.
    """
    first = -1
    for i in range(n):
        if across[i] != across[i - 1 if i > 0 else n - 1]:
            first = i
            break
    if first < 0:
        return n_junctions
    n_before = n_junctions
    stop, label = -1, 0
    opening, opening_label = -1, 0
    i = first
    while i < first + n:
        start = i
        beside = across[i % n]
        while i < first + n and across[i % n] == beside:
            i += 1
        if i - start < _MIN_ARC:
            continue
        if stop < 0:
            opening, opening_label = start, beside
        elif beside > 0 and label > 0 and beside != label:
            junctions[n_junctions] = (stop + start) // 2 % n
            n_junctions += 1
        stop, label = i, beside
    if label > 0 and opening_label > 0 and label != opening_label:
        junctions[n_junctions] = (stop + opening + n) // 2 % n
        n_junctions += 1
    if n_junctions > n_before:
        for k in range(n_before):
            junctions[k] %= n
        junctions[:n_junctions].sort()
    return n_junctions


@nb.njit(cache=True)
def _straight(steps, n, start, limit):  # type: ignore[no-untyped-def]
    """Longest digital straight segment from one crack on.

    Returns the number of cracks, the two steps d and e that it consists of (e = -1 where it is a
    single step), and the integers a, b, m of its strip m <= a u - b v < m + a + b, where u and v
    count the steps d and e: the segment has the direction b d + a e.
    """
    d, e = steps[start % n], -1
    a, b, m = 0, 1, 0
    u, v = 1, 0
    # Points that lean on the two sides of the strip, the first and the last on each.
    low_first_u, low_first_v, low_last_u, low_last_v = 0, 0, 1, 0
    high_first_u, high_first_v, high_last_u, high_last_v = 0, 0, 1, 0
    count = 1
    while count < limit:
        step = steps[(start + count) % n]
        next_u, next_v = u, v
        if step == d:
            next_u += 1
        elif step == e:
            next_v += 1
        elif e < 0 and (step - d) % 4 != 2:
            e = step
            next_v += 1
        else:
            break
        rest = a * next_u - b * next_v
        if m <= rest < m + a + b:
            if rest == m:
                low_last_u, low_last_v = next_u, next_v
            if rest == m + a + b - 1:
                high_last_u, high_last_v = next_u, next_v
        elif rest == m - 1:
            high_first_u, high_first_v = high_last_u, high_last_v
            low_last_u, low_last_v = next_u, next_v
            a, b = next_v - low_first_v, next_u - low_first_u
            m = a * next_u - b * next_v
        elif rest == m + a + b:
            low_first_u, low_first_v = low_last_u, low_last_v
            high_last_u, high_last_v = next_u, next_v
            a, b = next_v - high_first_v, next_u - high_first_u
            m = a * next_u - b * next_v - a - b + 1
        else:
            break
        u, v = next_u, next_v
        count += 1
    return count, d, e, a, b, m


@nb.njit(cache=True)
def _arc_length(steps, n, start, count, closed, points, ends):  # type: ignore[no-untyped-def]
    """Length of the arc of ``count`` cracks from ``start``; ``ends`` takes its end tangents.

    Each maximal straight segment carries the midpoints of its cracks onto its middle line. Where
    segments overlap, points and tangents are averaged with the root of the number of cracks as
    weight. The length is that of the steps between the averaged points along their tangents.
    """
    # Columns: vertex before the crack; weight, point and tangent of its midpoint.
    x, y = 0.0, 0.0
    for k in range(count):
        step = steps[(start + k) % n]
        points[k, 0], points[k, 1] = x, y
        points[k, 2:] = 0.0
        x += _DX[step]
        y += _DY[step]
    reach = 0
    if closed:
        before = _straight(steps, n, start + n - 1, min(n, _MAX_SEGMENT))
        reach = before[0] - 1
    for k in range(count):
        limit = min(count if closed else count - k, _MAX_SEGMENT)
        length, d, e, a, b, m = _straight(steps, n, start + k, limit)
        if k + length <= reach:
            continue  # part of a longer one
        reach = k + length
        across_x, across_y = 0, 0
        if e >= 0:
            across_x, across_y = _DX[e], _DY[e]
        tangent_x, tangent_y = b * _DX[d] + a * across_x, b * _DY[d] + a * across_y
        norm = 1.0 / np.sqrt(tangent_x * tangent_x + tangent_y * tangent_y)
        tangent_x *= norm
        tangent_y *= norm
        # A point of the middle line a u - b v = m + (a + b - 1)/2, nearest to the first vertex.
        middle = (m + 0.5 * (a + b - 1)) / (a * a + b * b)
        line_x = points[k, 0] + middle * (a * _DX[d] - b * across_x)
        line_y = points[k, 1] + middle * (a * _DY[d] - b * across_y)
        weight = np.sqrt(length)
        for q in range(k, k + length):
            i = q % count
            step = steps[(start + q) % n]
            along = (points[i, 0] + 0.5 * _DX[step] - line_x) * tangent_x
            along += (points[i, 1] + 0.5 * _DY[step] - line_y) * tangent_y
            points[i, 2] += weight
            points[i, 3] += weight * (line_x + along * tangent_x)
            points[i, 4] += weight * (line_y + along * tangent_y)
            points[i, 5] += weight * tangent_x
            points[i, 6] += weight * tangent_y
        if k == 0:
            ends[0], ends[1] = tangent_x, tangent_y
        ends[2], ends[3] = tangent_x, tangent_y
        if not closed and reach == count:
            break
    for k in range(count):
        for column in range(3, 7):
            points[k, column] /= points[k, 2]
    total = 0.0
    if not closed:
        first, last = steps[start % n], steps[(start + count - 1) % n]
        total += 0.5 * (_DX[first] * ends[0] + _DY[first] * ends[1])
        total += 0.5 * (_DX[last] * ends[2] + _DY[last] * ends[3])
    for k in range(0 if closed else 1, count):
        j = k - 1 if k > 0 else count - 1
        tangent_x = points[k, 5] + points[j, 5]
        tangent_y = points[k, 6] + points[j, 6]
        along = (points[k, 3] - points[j, 3]) * tangent_x
        along += (points[k, 4] - points[j, 4]) * tangent_y
        total += along / np.sqrt(tangent_x * tangent_x + tangent_y * tangent_y)
    return total


@nb.njit(cache=True)
def _lost_at_corner(turn, gain):  # type: ignore[no-untyped-def]
    """Mean length (px) missed at a corner, less the gain of fitting up to the corner.

    A row of pixels sees a tip only where its chord is at least one pixel long. For edges at
    angles alpha and beta to the row, alpha + beta = turn, the height missed is
    sin(alpha) sin(beta) / sin(turn), and along each edge that height times the sine of its
    angle; this is averaged over all directions of the rows and summed over rows and columns.
    """
    turn = min(abs(turn), _MAX_TURN)
    if turn < 1e-6:
        return 0.0
    mean = np.sin(1.5 * turn) / (3.0 * turn)
    mean += (1.0 - 2.0 * np.cos(turn)) * np.sin(0.5 * turn) / turn
    missed = np.sin(0.5 * turn) * mean * turn / (np.pi * np.sin(turn))
    return missed - gain * min(1.0, (turn / _FULL_TURN) ** 2)


@nb.njit(cache=True)
def _length(steps, outside, n, junctions, n_junctions, points):  # type: ignore[no-untyped-def]
    """Length of a whole contour: its arcs between junctions, and what is lost at these."""
    ends = np.empty(4)
    if n_junctions < 2:
        return _arc_length(steps, n, 0, n, True, points, ends)
    total = 0.0
    opening_x, opening_y, last_x, last_y = 0.0, 0.0, 0.0, 0.0
    for k in range(n_junctions + 1):
        start = junctions[k % n_junctions]
        if k < n_junctions:
            stop = junctions[k + 1] if k + 1 < n_junctions else junctions[0] + n
            total += _arc_length(steps, n, start, stop - start, False, points, ends)
            next_x, next_y = ends[0], ends[1]
        else:
            next_x, next_y = opening_x, opening_y
        if k == 0:
            opening_x, opening_y = next_x, next_y
        else:
            # Amid background the corner is between two lines, and its place less certain.
            amid = outside[start % n] == 0 and outside[(start - 1) % n] == 0
            cross, dot = last_x * next_y - last_y * next_x, last_x * next_x + last_y * next_y
            total += _lost_at_corner(np.arctan2(cross, dot), _LINE_GAIN if amid else _CORNER_GAIN)
        last_x, last_y = ends[2], ends[3]
    return total


@nb.njit(cache=True)
def _measure(labels, rows, columns, gap):  # type: ignore[no-untyped-def]
    height, width = labels.shape
    n_cells = len(rows)
    values = np.empty((n_cells, 6))
    flags = np.zeros((n_cells, 2), np.bool_)
    n_neighbours = np.zeros(n_cells, np.int64)
    steps = np.empty(1024, np.int8)
    outside = np.empty(1024, np.int64)
    seen = np.empty(64, np.int64)
    touching = np.empty(64, np.int64)
    junctions = np.empty(1024, np.int64)
    across = np.empty(1024, np.int64)
    points = np.empty((1024, 7))
    for cell in range(n_cells):
        row, column = rows[cell], columns[cell]
        label = labels[row, column]
        steps, outside, n = _trace(labels, row, column, steps, outside)
        # Sums over the pixels inside, in integers relative to the first pixel: each vertical
        # crack adds (or takes away) the pixels of its row from column to the crack.
        s, sx, sy, sxx, sxy, syy = 0, 0, 0, 0, 0, 0
        x, y = 0, 0
        low_x, high_x, high_y = 0, 0, 0
        n_seen, n_touching = 0, 0
        surrounding = outside[0]
        for i in range(n):
            step = steps[i]
            if step == 1 or step == 3:
                line = y if step == 1 else y - 1
                sign = 1 if step == 1 else -1
                count = sign * x
                first = sign * (x * (x - 1) // 2)
                s += count
                sx += first
                sy += count * line
                sxx += sign * ((x - 1) * x * (2 * x - 1) // 6)
                sxy += first * line
                syy += count * line * line
            beyond = outside[i]
            if beyond != surrounding:
                surrounding = -1
            if beyond == -1:
                flags[cell, 0] = True
            elif beyond == 0:
                # Look across the gap along the normal of the crack (to the left).
                look_x = column + x - (1 if step == 2 or step == 3 else 0)
                look_y = row + y - (1 if step == 0 or step == 3 else 0)
                normal = (step + 3) % 4
                for _ in range(gap):
                    look_x += _DX[normal]
                    look_y += _DY[normal]
                    if not (0 <= look_x < width and 0 <= look_y < height):
                        break
                    beyond = np.int64(labels[look_y, look_x])
                    if beyond != 0:
                        break
            if outside[i] > 0:
                known = False
                for j in range(n_touching - 1, -1, -1):
                    if touching[j] == beyond:
                        known = True
                        break
                if not known:
                    if n_touching == len(touching):
                        longer = np.empty(2 * n_touching, np.int64)
                        longer[:n_touching] = touching
                        touching = longer
                    touching[n_touching] = beyond
                    n_touching += 1
            if beyond > 0 and beyond != label:
                known = False
                for j in range(n_seen - 1, -1, -1):
                    if seen[j] == beyond:
                        known = True
                        break
                if not known:
                    if n_seen == len(seen):
                        longer = np.empty(2 * n_seen, np.int64)
                        longer[:n_seen] = seen
                        seen = longer
                    seen[n_seen] = beyond
                    n_seen += 1
            x += _DX[step]
            y += _DY[step]
            low_x, high_x, high_y = min(low_x, x), max(high_x, x), max(high_y, y)
        n_neighbours[cell] = n_seen
        flags[cell, 1] = surrounding > 0
        mean_x, mean_y = sx / s, sy / s
        # Central second moments of unit squares, not of points: hence 1/12.
        xx = sxx / s - mean_x * mean_x + 1.0 / 12.0
        yy = syy / s - mean_y * mean_y + 1.0 / 12.0
        xy = sxy / s - mean_x * mean_y
        spread = np.hypot(0.5 * (xx - yy), xy)
        middle = 0.5 * (xx + yy)
        angle = 0.5 * np.arctan2(2.0 * xy, xx - yy)
        values[cell, 0] = column + mean_x
        values[cell, 1] = row + mean_y
        values[cell, 2] = s
        coarse = s < _MIN_AREA or min(high_x - low_x, high_y) < _MIN_WIDTH
        values[cell, 3] = np.nan
        if not coarse:
            if n > len(points):
                points = np.empty((2 * n, 7))
                junctions = np.empty(2 * n, np.int64)
                across = np.empty(2 * n, np.int64)
            n_junctions = _junctions(outside, n, junctions)
            if n_seen > n_touching + 1:  # two cells at least lie across lines
                n_across = _across_lines(
                    labels, row, column, steps, outside, n, touching, n_touching, across
                )
                if n_across >= _LINED * n:
                    n_junctions = _line_junctions(across, n, junctions, n_junctions)
            values[cell, 3] = _length(steps, outside, n, junctions, n_junctions, points)
        values[cell, 4] = np.sqrt((middle + spread) / (middle - spread))
        values[cell, 5] = angle if angle > -0.5 * np.pi else 0.5 * np.pi
    return values, flags, n_neighbours

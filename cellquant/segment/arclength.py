"""Length of a closed path along cracks, as that of the curve that the pixels stand for.

It is the length of a curve through overlapping digital straight segments, which are long where the
contour is straight and short where it bends, so that nothing has to be known of the size of the
cells. Segments end at corners, and the length that pixels miss at the tip is added.

References
----------
Debled-Rennesson & Reveilles, Int. J. Pattern Recognition and Artificial Intelligence 9, 635
(1995), doi:10.1142/S0218001495000249: recognition of digital straight segments.
Lachaud, Vialard & de Vieilleville, Image and Vision Computing 25, 1572 (2007),
doi:10.1016/j.imavis.2006.06.019: averages over maximal segments.
"""

import numba as nb
import numpy as np

from cellquant.segment.crackpaths import DX, DY

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


@nb.njit(cache=True)
def straight_segment(steps, n, start, limit):  # type: ignore[no-untyped-def]
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
def arc_length(steps, n, start, count, closed, points, ends):  # type: ignore[no-untyped-def]
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
        x += DX[step]
        y += DY[step]
    reach = 0
    if closed:
        before = straight_segment(steps, n, start + n - 1, min(n, _MAX_SEGMENT))
        reach = before[0] - 1
    for k in range(count):
        limit = min(count if closed else count - k, _MAX_SEGMENT)
        length, d, e, a, b, m = straight_segment(steps, n, start + k, limit)
        if k + length <= reach:
            continue  # part of a longer one
        reach = k + length
        across_x, across_y = 0, 0
        if e >= 0:
            across_x, across_y = DX[e], DY[e]
        tangent_x, tangent_y = b * DX[d] + a * across_x, b * DY[d] + a * across_y
        norm = 1.0 / np.sqrt(tangent_x * tangent_x + tangent_y * tangent_y)
        tangent_x *= norm
        tangent_y *= norm
        # A point of the middle line a u - b v = m + (a + b - 1)/2, nearest to the first vertex.
        middle = (m + 0.5 * (a + b - 1)) / (a * a + b * b)
        line_x = points[k, 0] + middle * (a * DX[d] - b * across_x)
        line_y = points[k, 1] + middle * (a * DY[d] - b * across_y)
        weight = np.sqrt(length)
        for q in range(k, k + length):
            i = q % count
            step = steps[(start + q) % n]
            along = (points[i, 0] + 0.5 * DX[step] - line_x) * tangent_x
            along += (points[i, 1] + 0.5 * DY[step] - line_y) * tangent_y
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
        total += 0.5 * (DX[first] * ends[0] + DY[first] * ends[1])
        total += 0.5 * (DX[last] * ends[2] + DY[last] * ends[3])
    for k in range(0 if closed else 1, count):
        j = k - 1 if k > 0 else count - 1
        tangent_x = points[k, 5] + points[j, 5]
        tangent_y = points[k, 6] + points[j, 6]
        along = (points[k, 3] - points[j, 3]) * tangent_x
        along += (points[k, 4] - points[j, 4]) * tangent_y
        total += along / np.sqrt(tangent_x * tangent_x + tangent_y * tangent_y)
    return total


@nb.njit(cache=True)
def lost_at_corner(turn, gain):  # type: ignore[no-untyped-def]
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
def contour_length(steps, outside, n, junctions, n_junctions, points):  # type: ignore[no-untyped-def]
    """Length of a whole contour: its arcs between junctions, and what is lost at these."""
    ends = np.empty(4)
    if n_junctions < 2:
        return arc_length(steps, n, 0, n, True, points, ends)
    total = 0.0
    opening_x, opening_y, last_x, last_y = 0.0, 0.0, 0.0, 0.0
    for k in range(n_junctions + 1):
        start = junctions[k % n_junctions]
        if k < n_junctions:
            stop = junctions[k + 1] if k + 1 < n_junctions else junctions[0] + n
            total += arc_length(steps, n, start, stop - start, False, points, ends)
            next_x, next_y = ends[0], ends[1]
        else:
            next_x, next_y = opening_x, opening_y
        if k == 0:
            opening_x, opening_y = next_x, next_y
        else:
            # Amid background the corner is between two lines, and its place less certain.
            amid = outside[start % n] == 0 and outside[(start - 1) % n] == 0
            cross, dot = last_x * next_y - last_y * next_x, last_x * next_x + last_y * next_y
            total += lost_at_corner(np.arctan2(cross, dot), _LINE_GAIN if amid else _CORNER_GAIN)
        last_x, last_y = ends[2], ends[3]
    return total

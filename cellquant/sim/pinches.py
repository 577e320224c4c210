r"""Cells whose contour pinches at its centre, and the exact rule for them.

A cell is the set of points with r < R(phi). It has no extent in directions with R(phi) <= 0: there
its contour passes through its centre, and the cell consists of lobes that meet there, whose area is
kept (see `areas`). The energy stays continuously differentiable across the pinch: its overlap areas
change by R dR and its length by an integrand that is small where R and dR/dphi are both small.

For such cells the arcs inside a neighbour also end where R = 0, if the neighbour holds the centre.
These ends stand among the crossings of a pair as entries of one cell alone: their radius is zero,
so that they enter the arcs W_k and neither chord nor torque; for the other cell they come in pairs
that cancel.
"""

import math
from typing import Any

import numpy as np
from numba import njit

from cellquant.sim.lenses import sum_lens
from cellquant.sim.records import HEAD

NARROW = 0.3  # radius over R0 below which crossings are sought on this contour: its own radius
# varies fast with the direction
SHARP = 0.05  # radius over R0 below which the contour's length needs graded panels
SAMPLES = 128  # of R(phi), between which its zeros are sought
SHORTEST = 1e-5  # gaps in a contour of a smaller angle are left out
MOST_ZEROS = 48  # of a contour of 24 modes
MOST_PANELS = 1024  # of a contour whose tangent nearly vanishes in places
NODES, WEIGHTS = np.polynomial.legendre.leggauss(12)


@njit(cache=True, error_model="numpy")
def radius_towards(record: Any, i: int, angle: float, n_modes: int) -> tuple[float, float]:
    """R and dR/dphi of a contour in one direction."""
    rho = record[i, 2]
    slope = 0.0
    cos_1 = math.cos(angle)
    sin_1 = math.sin(angle)
    c = cos_1
    s = sin_1
    for m in range(n_modes):
        c, s = c * cos_1 - s * sin_1, s * cos_1 + c * sin_1
        re = record[i, HEAD + m]
        im = record[i, HEAD + n_modes + m]
        rho += re * c - im * s
        slope -= (m + 2) * (re * s + im * c)
    return rho, slope


@njit(cache=True, error_model="numpy")
def least_between(record: Any, i: int, low: float, high: float, n_modes: int) -> float:
    """The zero of dR/dphi between two angles where it has different signs, by bisection."""
    _, start = radius_towards(record, i, low, n_modes)
    for _ in range(60):
        middle = 0.5 * (low + high)
        _, slope = radius_towards(record, i, middle, n_modes)
        if (slope > 0.0) == (start > 0.0):
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


@njit(cache=True, error_model="numpy")
def zero_between(record: Any, i: int, low: float, high: float, n_modes: int) -> float:
    """The zero of R between two angles where it has different signs, by Newton and bisection."""
    rho, _ = radius_towards(record, i, low, n_modes)
    positive = rho > 0.0
    angle = 0.5 * (low + high)
    for _ in range(60):
        rho, slope = radius_towards(record, i, angle, n_modes)
        if (rho > 0.0) == positive:
            low = angle
        else:
            high = angle
        guess = angle - rho / slope if slope != 0.0 else low
        if not low < guess < high:
            guess = 0.5 * (low + high)
        if abs(guess - angle) <= 4e-16:
            break
        angle = guess
    return angle


@njit(cache=True, error_model="numpy")
def gaps(record: Any, i: int, n_modes: int, ends: Any) -> int:
    """Angles between which R < 0, alternately start and stop; return their number (even)."""
    spacing = 2.0 * math.pi / SAMPLES
    marks = np.empty(3)
    count = 0
    rho_0, slope_0 = radius_towards(record, i, 0.0, n_modes)
    first = rho_0
    for s in range(SAMPLES):
        low = s * spacing
        rho_1, slope_1 = radius_towards(record, i, low + spacing, n_modes)
        n_parts = 1
        marks[0] = low
        hidden = (rho_0 > 0.0) == (rho_1 > 0.0) and (
            slope_0 < 0.0 < slope_1 if rho_0 > 0.0 else slope_0 > 0.0 > slope_1
        )
        if hidden:
            marks[1] = least_between(record, i, low, low + spacing, n_modes)
            n_parts = 2
        marks[n_parts] = low + spacing
        before = rho_0
        for part in range(n_parts):
            after = rho_1
            if part < n_parts - 1:
                after, _ = radius_towards(record, i, marks[part + 1], n_modes)
            if (before > 0.0) != (after > 0.0) and count < ends.shape[0]:
                ends[count] = zero_between(record, i, marks[part], marks[part + 1], n_modes)
                count += 1
            before = after
        rho_0, slope_0 = rho_1, slope_1
    count -= count % 2
    if not first > 0.0 and count > 0:  # the first end closes a gap that began before angle zero
        last = ends[count - 1] - 2.0 * math.pi
        for e in range(count - 1, 0, -1):
            ends[e] = ends[e - 1]
        ends[0] = last
    kept = 0
    for e in range(0, count, 2):
        if ends[e + 1] - ends[e] > SHORTEST:
            ends[kept] = ends[e]
            ends[kept + 1] = ends[e + 1]
            kept += 2
    return kept


@njit(cache=True, error_model="numpy")
def alternate(angle: Any, sign: Any, count: int) -> bool:
    """Whether the arc ends of a contour, sorted by angle (in place), open and close in turn."""
    for e in range(1, count):
        a = angle[e]
        s = sign[e]
        f = e - 1
        while f >= 0 and angle[f] > a:
            angle[f + 1] = angle[f]
            sign[f + 1] = sign[f]
            f -= 1
        angle[f + 1] = a
        sign[f + 1] = s
    turns = 0
    for e in range(count):
        turns += sign[e] != sign[(e + 1) % count]
    return turns == count


@njit(cache=True, error_model="numpy")
def centre_is_held(
    roots: Any, start: int, stop: int, second: bool, ends: Any, n_ends: int, room: Any
) -> bool:  # fmt: skip
    """Whether the arcs of a pinched cell inside its neighbour end at its gaps.

    They do where the neighbour holds the cell's centre, and only then do the signs of the
    crossings and of the gaps alternate round the contour.
    """
    column = 4 if second else 0
    count = 0
    for r in range(start, stop):
        room[0, count] = math.atan2(roots[r, column + 1], roots[r, column]) % (2.0 * math.pi)
        room[1, count] = roots[r, column + 2]
        count += 1
    for e in range(n_ends):
        room[0, count] = ends[e] % (2.0 * math.pi)
        room[1, count] = 1.0 if e % 2 == 0 else -1.0
        count += 1
    return alternate(room[0], room[1], count)


@njit(cache=True, error_model="numpy")
def add_gaps(
    record: Any, pinched: Any, first: Any, other: Any, roots: Any, root_first: Any, root_last: Any,
    lenses: Any, inside: Any, tail: int, n_modes: int,
) -> int:  # fmt: skip
    """Put the gaps of pinched contours among the crossings of their pairs, from `tail` on.

    Crossings on the part of a contour beyond its centre are dropped. Returns the room used in
    `roots`; where that is more than there is, nothing is right and the room must be enlarged.
    """
    most: int = roots.shape[0]
    ends = np.empty((2, MOST_ZEROS))
    room = np.empty((2, 4096))
    for i in range(first.shape[0] - 1):
        n_i = -1
        for p in range(first[i], first[i + 1]):
            j = other[p]
            if not (pinched[i] or pinched[j]):
                continue
            start, stop = root_first[p], root_last[p]
            if start == stop and inside[p] == 0:
                continue
            if stop - start + 2 * MOST_ZEROS > min(room.shape[1], most - tail):
                return int(most + stop - start + 2 * MOST_ZEROS)
            if n_i < 0:
                n_i = gaps(record, i, n_modes, ends[0]) if pinched[i] else 0
            n_j = gaps(record, j, n_modes, ends[1]) if pinched[j] else 0
            begin = tail
            for r in range(start, stop):
                if roots[r, 3] > 0.0:
                    roots[tail] = roots[r]
                    tail += 1
            crossed = tail
            if n_i > 0 and inside[p] != 2 and centre_is_held(
                roots, begin, crossed, False, ends[0], n_i, room
            ):  # fmt: skip
                for e in range(n_i):
                    roots[tail] = 0.0
                    roots[tail, 0] = math.cos(ends[0, e])
                    roots[tail, 1] = math.sin(ends[0, e])
                    roots[tail, 2] = 1.0 if e % 2 == 0 else -1.0
                    roots[tail, 4] = 1.0
                    roots[tail, 6] = -roots[tail, 2]
                    tail += 1
                inside[p] = 0
            if n_j > 0 and inside[p] != 1 and centre_is_held(
                roots, begin, crossed, True, ends[1], n_j, room
            ):  # fmt: skip
                for e in range(n_j):
                    roots[tail] = 0.0
                    roots[tail, 0] = 1.0
                    roots[tail, 2] = -1.0 if e % 2 == 0 else 1.0
                    roots[tail, 4] = math.cos(ends[1, e])
                    roots[tail, 5] = math.sin(ends[1, e])
                    roots[tail, 6] = -roots[tail, 2]
                    tail += 1
                inside[p] = 0
            root_first[p] = begin
            root_last[p] = tail
            sum_lens(roots, begin, tail, lenses, p)
    return tail


@njit(cache=True, error_model="numpy")
def graded_panels(
    record: Any, i: int, begin: float, whole: float, n_panels: int, bend: float, n_modes: int,
    panels: Any,
) -> int:  # fmt: skip
    """Divide a part of contour i where its tangent could vanish; return the number of panels.

    The integrand of a length is as smooth as its smallest tangent is long: panels are halved until
    they are shorter than their distance from the place where it could vanish, |t| / `bend`. Rows of
    `panels` take start and width; where there is no row left they stay as wide as they are.
    """
    for panel in range(n_panels):
        panels[panel, 0] = begin + panel * whole / n_panels
        panels[panel, 1] = whole / n_panels
    count = n_panels
    panel = 0
    while panel < count:
        width = panels[panel, 1]
        rho, slope = radius_towards(record, i, panels[panel, 0] + 0.5 * width, n_modes)
        halved = math.hypot(rho, slope) < bend * width and width > 1e-9
        if halved and count < panels.shape[0]:
            panels[panel, 1] = 0.5 * width
            panels[count, 0] = panels[panel, 0] + 0.5 * width
            panels[count, 1] = 0.5 * width
            count += 1
        else:
            panel += 1
    return count


@njit(cache=True, error_model="numpy")
def measure_lengths(record: Any, cells: Any, n_modes: int, tangent: Any) -> None:
    """Length of some contours and their gradients (see `outlines.contours`) on graded panels."""
    panels = np.empty((MOST_PANELS, 2))
    for i in cells:
        bend = record[i, 2]
        for m in range(n_modes):
            n = m + 2
            bend += (n * n + 2.0 * n + 1.0) * math.hypot(
                record[i, HEAD + m], record[i, HEAD + n_modes + m]
            )
        tangent[i, :] = 0.0
        count = graded_panels(record, i, 0.0, 2.0 * math.pi, 16, bend, n_modes, panels)
        for panel in range(count):
            low = panels[panel, 0]
            width = panels[panel, 1]
            for g in range(NODES.shape[0]):
                angle = low + 0.5 * width * (1.0 + NODES[g])
                share = 0.5 * width * WEIGHTS[g]
                rho, slope = radius_towards(record, i, angle, n_modes)
                stretch = math.hypot(rho, slope)
                if stretch == 0.0:
                    continue
                tangent[i, 0] += share * stretch
                u = share * rho / stretch
                v = share * slope / stretch
                tangent[i, 1] += u
                c_1 = math.cos(angle)
                s_1 = math.sin(angle)
                c = c_1
                s = s_1
                for m in range(n_modes):
                    n = m + 2
                    c, s = c * c_1 - s * s_1, s * c_1 + c * s_1
                    tangent[i, 2 + m] += u * c - n * v * s
                    tangent[i, 2 + n_modes + m] += u * s + n * v * c

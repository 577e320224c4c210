"""Where the contours of neighbouring cells cross: the root search of the exact contact rule.

The depth g of i's contour inside j is sampled in single precision on the part of the contour that
faces j. The cubic through two neighbouring samples and their slopes shows how often the contours
cross between them, and where, to about 1e-5. One evaluation in double precision then gives the
crossing to round-off. What single precision or the cubic cannot settle is left to `grazes`.

An overlap region is bounded by arcs of both contours. Every integral over the arcs is a signed sum
over the crossings (+1 where the contour of i leaves j, -1 where it enters), so neither the number
of crossings nor their order matters.
"""

import math
from typing import Any

import numpy as np
from numba import njit

from cellquant.sim.grazes import FLAGS, gap, search_closely, search_gap, settle
from cellquant.sim.lanes import LANES, bits, load, load_pair, peek, poke, zeros
from cellquant.sim.lenses import LENS, ROOT, sum_lens, sum_lenses
from cellquant.sim.outlines import BLOCK
from cellquant.sim.parts import features_of, shared, taken
from cellquant.sim.polishing import TWO, UNSURE, judge_gaps, polish
from cellquant.sim.sampling import (
    ANGLE,
    CLOSELY,
    HIGH,
    INSIDE,
    KIND,
    LISTED,
    LOW,
    PAIR,
    PAIRS,
    PLACE,
    SAMPLE,
    SIGN,
    TARGET,
    find_windows,
    list_gaps,
    place_pairs,
    sample_pairs,
)

MOST_OF_A_GAP = 64  # crossings, where it is searched in double precision
SETTLED = 2e-9  # error of an angle that needs no further steps
EVERY = np.uint64((1 << LANES) - 1)  # lanes of a mask
OVERFLOW = 1  # more crossings than the buffer holds


def work(n_parts: int, size: int) -> tuple[Any, ...]:
    """Work arrays too large to be made anew at every call; `size` samples of a contour."""
    return (
        zeros(n_parts, 6, LISTED, kind=np.int64),
        zeros(n_parts, 20, LISTED, kind=np.float32),
        zeros(n_parts, 17, LISTED),
        zeros(n_parts, 2, PAIRS * (size + 5 * LANES), kind=np.float32),
    )


@njit(cache=True, fastmath=FLAGS, error_model="numpy", forceinline=True)
def copy_gap(source: int, to: int, rows: Any, piece: Any) -> None:
    """List a gap once more."""
    for row in range(SAMPLE, TARGET, LISTED):
        poke(rows, row + to, peek(rows, row + source))
    for row in range(ANGLE, KIND, LISTED):
        poke(piece, row + to, peek(piece, row + source))


@shared(FLAGS)
def crossings(part: int, n_parts: int, kept: Any, state: Any, velocity: Any) -> None:
    """Find where the contours of every listed pair cross.

    `roots` has the same room for every block of cells; the crossings of pair p are the rows
    root_first[p] to root_last[p], and `lenses` takes their sums (see there). `inside` is 1 where i
    lies in j, 2 where j lies in i. Every part has its own work arrays (see `work`).
    """
    (
        record, grid, rim, pattern, circle, compass, first, owners, other, shift, roots, root_first,
        root_last, lenses, inside, fault, gaps, pieces, lines_of, samples,
    ) = taken(kept)  # fmt: skip
    modes, _, _ = features_of(kept)
    n_cells = record.shape[0]
    stride = record.shape[1]
    size = 8 * max(6, len(modes) + 1)
    spacing: Any = np.float32(2.0 * math.pi / size)
    n_blocks = (n_cells + BLOCK - 1) // BLOCK
    room = roots.shape[0] // n_blocks
    near = np.zeros(5 * PAIRS, np.float32)
    apart = np.zeros((PAIRS, 4))
    start = np.empty(PAIRS, np.float32)
    count = np.empty(PAIRS, np.float32)
    ends = np.zeros((3, PAIRS), np.int64)
    code = np.empty(PAIRS, np.int64)
    total = np.empty(PAIRS, np.int64)
    cursor = np.empty(PAIRS, np.int64)
    depth = samples[part, 0]
    change = samples[part, 1]
    rows = gaps[part]
    piece = pieces[part]
    lines = lines_of[part]
    scratch = np.empty((2 * len(modes) + 4) * LANES)
    stack = np.empty((40, 6))
    found = np.empty((8 * size, 5))
    brackets = np.empty((8 * size, 5))
    pair_of = np.empty(8 * size, np.int64)
    for block in range(n_blocks):
        if not part * n_blocks <= block * n_parts < (part + 1) * n_blocks:
            continue
        n_roots = block * room
        full = n_roots + room - 1
        dump = full  # row for what is none
        last_pair = first[min(n_cells, (block + 1) * BLOCK)]
        n_pairs = last_pair - first[block * BLOCK]
        n_batches = (n_pairs + PAIRS - 1) // PAIRS
        for batch in range(n_batches):
            begin = last_pair - n_pairs + batch * n_pairs // n_batches
            filled = last_pair - n_pairs + (batch + 1) * n_pairs // n_batches - begin
            for k in range(filled):
                p = begin + k
                poke(ends, k, peek(owners, p) * stride)
                poke(ends, PAIRS + k, peek(other, p) * stride)
                poke(ends, 2 * PAIRS + k, 2 * p)
            place_pairs(record, shift, begin, filled, ends, near, apart, code)
            owner = owners[begin : begin + filled]
            listed = other[begin : begin + filled]
            find_windows(near, start, count, filled, modes)
            sample_pairs(
                grid, rim, pattern, owner, listed, near, start, count, filled, modes, depth, change,
                code,
            )  # fmt: skip
            n_gaps = list_gaps(
                pattern, owner, listed, start, count, filled, size, stride, depth, change,
                rows, piece, code, total,
            )  # fmt: skip
            # First the first crossing of every gap; those with two are then listed once more.
            n_listed = n_gaps
            n_apart: Any = np.int64(0)
            for second in range(2):
                judge_gaps(
                    depth, change, rows, second * n_gaps, n_listed if second else n_gaps,
                    second == 1, spacing, piece,
                )  # fmt: skip
                if second:
                    break
                for begin_of_it in range(0, n_gaps, LANES):
                    if bits(load(piece, KIND + begin_of_it) != 1.0) == np.uint64(0):
                        continue  # the commonest case is counted already
                    for g in range(begin_of_it, min(begin_of_it + LANES, n_gaps)):
                        number = int(peek(piece, KIND + g))
                        k = peek(rows, PAIR + g) >> 2
                        if number >= UNSURE and code[k] != CLOSELY:
                            after = -1
                            if number == UNSURE and n_apart + MOST_OF_A_GAP <= brackets.shape[0]:
                                at = peek(rows, PLACE + g)
                                after = search_gap(
                                    record, owner[k], listed[k], apart[k, 0], apart[k, 1],
                                    compass, peek(rows, SAMPLE + g) >> 2, depth[at],
                                    depth[at + 1], modes, stack, brackets, n_apart,
                                )  # fmt: skip
                            if after < 0:
                                code[k] = CLOSELY
                            else:
                                pair_of[n_apart:after] = k
                                number = after - n_apart
                                n_apart = after
                                poke(piece, KIND + g, 0.0)
                        poke(total, k, peek(total, k) + number - 1)
                        if number == TWO and peek(piece, KIND + g) > 0.0:
                            copy_gap(g, n_listed, rows, piece)
                            n_listed += 1
                for g in range(n_listed, n_listed + 2 * LANES):
                    poke(rows, PLACE + g, LANES)
            for k in range(filled):
                p = begin + k
                number = peek(total, k)
                poke(root_first, p, n_roots)
                poke(inside, p, 0)
                if number > 0 and peek(code, k) != CLOSELY and n_roots + number <= full:
                    poke(cursor, k, n_roots)
                    n_roots += number
                    poke(root_last, p, n_roots)
                    continue
                n_samples = int(count[k])
                empty = number == 0
                within = code[k] == INSIDE
                if n_samples > 0 and code[k] == CLOSELY:
                    n_found = search_closely(
                        record, owner[k], other[p], apart[k, 0], apart[k, 1], compass,
                        int(start[k]), n_samples, modes, stack, found,
                    )  # fmt: skip
                    if n_found == -1:
                        inside[p] = 1  # the same contour twice: i counts as inside j
                    empty = n_found == 0
                    within = empty and found[0, 3] > 0.0
                    if n_roots + n_found > full:
                        fault[block] = OVERFLOW
                        n_found = 0
                    for q in range(n_found):
                        s = int(found[q, 0])
                        settle(
                            record, owner[k], other[p], apart[k, 0], apart[k, 1],
                            compass[0, s], compass[1, s], found[q, 1], found[q, 2], found[q, 4],
                            found[q, 3], modes, roots, n_roots,
                        )  # fmt: skip
                        n_roots += 1
                elif n_roots + total[k] > full:
                    fault[block] = OVERFLOW
                    code[k] = CLOSELY
                else:
                    cursor[k] = n_roots
                    n_roots += total[k]
                root_last[p] = n_roots
                if empty and n_samples > 0:
                    reach = math.sqrt(apart[k, 0] ** 2 + apart[k, 1] ** 2) + record[other[p], 4]
                    if n_samples > size and within:
                        inside[p] = 1
                    elif reach < record[owner[k], 3]:
                        inner, _, _, _, _, _, _ = gap(
                            record, other[p], owner[k], -apart[k, 0], -apart[k, 1], 1.0, 0.0,
                            modes,
                        )  # fmt: skip
                        if inner > 0.0:
                            inside[p] = 2
            for row in range(n_apart):
                k = pair_of[row]
                if code[k] == CLOSELY:
                    continue
                r = cursor[k]
                cursor[k] = r + 1
                s = int(brackets[row, 0])
                settle(
                    record, owner[k], listed[k], apart[k, 0], apart[k, 1], compass[0, s],
                    compass[1, s], brackets[row, 1], brackets[row, 2], brackets[row, 4],
                    brackets[row, 3], modes, roots, r,
                )  # fmt: skip
            partner = n_gaps
            for g in range(n_gaps):
                number = int(peek(piece, KIND + g))
                k = peek(rows, PAIR + g) >> 2
                dead = (peek(code, k) == CLOSELY) | (number == 0)
                r = peek(cursor, k)
                poke(cursor, k, r + number)
                poke(rows, TARGET + g, ROOT * (dump if dead else r))
                if number == TWO:
                    poke(rows, TARGET + partner, ROOT * (dump if dead else r + 1))
                    partner += 1
            for g in range(n_listed, (n_listed + LANES - 1) // LANES * LANES):
                copy_gap(n_listed - 1, g, rows, piece)
                poke(rows, TARGET + g, ROOT * dump)
            polish(
                circle, apart, record, rows, piece, n_listed, modes, scratch, lines, roots
            )  # fmt: skip
            # What one step does not settle takes safeguarded ones.
            for begin_of_it in range(0, n_listed, LANES):
                if bits(load_pair(lines, begin_of_it) < SETTLED) == EVERY:
                    continue
                for g in range(begin_of_it, min(begin_of_it + LANES, n_listed)):
                    if lines[0, g] < SETTLED or peek(rows, TARGET + g) == ROOT * dump:
                        continue
                    k = rows[1, g] // 4
                    s = rows[0, g] // 4
                    settle(
                        record, owner[k], listed[k], apart[k, 0], apart[k, 1], compass[0, s],
                        compass[1, s], np.float64(peek(piece, LOW + g)),
                        np.float64(peek(piece, HIGH + g)), lines[1, g],
                        np.float64(peek(piece, SIGN + g)), modes, roots,
                        peek(rows, TARGET + g) // ROOT,
                    )  # fmt: skip
            # Nearly every pair has two crossings; those are summed up side by side.
            n_twice = 0
            for k in range(filled):
                p = begin + k
                r = peek(root_first, p)
                number = peek(root_last, p) - r
                if number == 2 and peek(roots, ROOT * r + 2) * peek(roots, ROOT * r + 10) < 0.0:
                    poke(rows, SAMPLE + n_twice, ROOT * r)
                    poke(rows, PAIR + n_twice, ROOT * (r + 1))
                    poke(rows, TARGET + n_twice, LENS * p)
                    n_twice += 1
                elif number > 0:
                    sum_lens(roots, r, r + number, lenses, p)
            if n_twice > 0:
                for k in range(n_twice, (n_twice + LANES - 1) // LANES * LANES):
                    for row in (SAMPLE, PAIR, TARGET):
                        poke(rows, row + k, peek(rows, row + n_twice - 1))
                sum_lenses(roots, rows, n_twice, PAIR, lenses, TARGET)

"""Compiled belief propagation: how likely a link or a division is among its rivals."""

from typing import Any

import numpy as np
from numba import njit

FloatArray = np.ndarray[Any, np.dtype[np.float64]]
IntArray = np.ndarray[Any, np.dtype[np.int64]]


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
    # Odds of each link, divided by its rivals at its source, and by those at its target.
    odds, asked, arrived = np.empty(most * k), np.empty(most * k), np.empty(most * k)
    target, place = np.empty(most * k, dtype=np.int64), np.empty(most * k, dtype=np.int64)
    begin, total_column = np.empty(most + 1, dtype=np.int64), np.empty(most)
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
                second = max(second, min(g, top))
                best = c if g > top else best
                top = max(g, top)
                before = top_column[j]
                second_column[j] = max(second_column[j], min(g, before))
                first_column[j] = i if g > before else first_column[j]
                top_column[j] = max(g, before)
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
            begin[i] = links
            if closed_row[i]:
                continue
            for c in range(k):
                g, j = gain[first + i, c], candidates[first + i, c] - there
                if j >= 0 and g >= least and not closed_column[j]:
                    target[links], place[links] = j, c
                    odds[links] = arrived[links] = np.exp(min(g, limit))
                    links += 1
        begin[n] = links
        for _ in range(rounds):
            total_column[:] = 1.0
            for i in range(n):
                total = 1.0
                for q in range(begin[i], begin[i + 1]):
                    total += arrived[q]
                for q in range(begin[i], begin[i + 1]):
                    asked[q] = odds[q] / max(total - arrived[q], 1.0)
                    total_column[target[q]] += asked[q]
            for q in range(links):
                arrived[q] = odds[q] / max(total_column[target[q]] - asked[q], 1.0)
        for i in range(n):
            for q in range(begin[i], begin[i + 1]):
                belief = asked[q] * arrived[q] / odds[q]
                out[first + i, place[q]] = belief / (1.0 + belief)


@njit(cache=True)
def option_marginals(cells: IntArray, gain: FloatArray, rounds: int, out: FloatArray) -> None:
    """Probability of every link or division by belief propagation, out (O,).

    Options use the cells (O, 3), -1 where an option has fewer, and no cell is used twice;
    ``exp(gain)`` is the odds of an option against leaving its cells alone. Exact where options and
    cells form a tree, and close to it elsewhere.
    """
    n = 0
    for o in range(len(gain)):
        for c in range(3):
            n = max(n, cells[o, c] + 1)
    odds = np.exp(np.minimum(gain, 300.0))
    message, asked = np.ones(cells.shape), np.empty(cells.shape)
    total = np.empty(n)
    for _ in range(rounds):
        total[:] = 1.0
        for o in range(len(gain)):
            for c in range(3):
                if cells[o, c] >= 0:
                    value = odds[o]
                    for d in range(3):
                        if d != c:
                            value *= message[o, d]
                    asked[o, c] = value
                    total[cells[o, c]] += value
        for o in range(len(gain)):
            for c in range(3):
                if cells[o, c] >= 0:
                    message[o, c] = 1.0 / max(total[cells[o, c]] - asked[o, c], 1.0)
    for o in range(len(gain)):
        belief = odds[o] * message[o, 0] * message[o, 1] * message[o, 2]
        out[o] = belief / (1.0 + belief)

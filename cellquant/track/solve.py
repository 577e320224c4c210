"""Passes over the movie: gains from the present model, best links, a better model."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from cellquant.track.assign import match_with_divisions
from cellquant.track.costs import (
    Links,
    Motion,
    Paths,
    Rates,
    Shapes,
    first_motion,
    fit_motion,
    fit_rates,
    fit_shapes,
    gains,
    near_edge,
    paths,
    suppose_divisions,
)
from cellquant.track.divisions import Divisions, fit_divisions, predicted_middle, propose
from cellquant.track.flow import all_flows, nearest_cells
from cellquant.track.kernels import marginals
from cellquant.track.movie import FloatArray, IntArray, Movie

PASSES = 5
_UNLIKELY = 1e-4  # links below this probability are not offered to the assignment
_SURE = 0.9  # a cell whose mother is known with this probability needs no division
_DIVISION_PASS = 1  # the first pass that looks for divisions


@dataclass(frozen=True)
class Solution:
    """Links with the model that they were judged by."""

    links: Links
    paths: Paths
    motion: Motion
    shapes: Shapes
    rates: Rates
    divisions: Divisions | None
    candidates: IntArray
    gain: FloatArray
    flow: FloatArray
    leave: FloatArray
    appear: FloatArray


def solve(
    movie: Movie,
    *,
    divisions: bool,
    max_distance: float,
    progress: Callable[[int, int], None] | None = None,
) -> Solution:
    """Link the cells of successive frames.

    Parameters
    ----------
    movie
        At least two frames with cells.
    divisions
        Look for divisions.
    max_distance
        Longest displacement that is considered.
    progress
        Called with the number of steps done and of all steps.
    """
    pairs = len(movie.time) - 1
    total = (PASSES + 1) * pairs
    flow = all_flows(movie)
    if progress is not None:
        progress(pairs, total)
    candidates = np.full((movie.n_cells, nearest_width()), -1, dtype=np.int64)
    for index in range(pairs):
        a, b = movie.cells_of(index), movie.cells_of(index + 1)
        found = nearest_cells(movie.position[a] + flow[a], movie.position[b])
        candidates[a] = np.where(found >= 0, found + movie.start[index + 1], -1)
    leaving, entering = near_edge(movie, flow)
    links: Links | None = None
    known = paths(movie, None, flow)
    motion = first_motion(float(np.median(movie.spacing)))
    none = np.empty(0, dtype=np.int64)
    shapes = fit_shapes(movie, none, none, np.empty(0))
    rates = fit_rates(movie, None, leaving, entering)
    model: Divisions | None = None
    gain = np.empty(candidates.shape)
    for turn in range(PASSES):
        if links is not None:
            known = paths(movie, links, flow)
            motion = fit_motion(movie, links, known, motion)
            single = np.flatnonzero((links.after >= 0) & (links.second < 0))
            target = links.after[single]
            shapes = fit_shapes(movie, single, target, links.confidence[target])
            rates = fit_rates(movie, links, leaving, entering)
            if divisions and turn == _DIVISION_PASS:
                rates = suppose_divisions(rates)
        gain, leave, appear = gains(
            movie, candidates, known, motion, shapes, rates, leaving, entering, max_distance
        )
        middle = predicted_middle(movie, known, motion)
        if divisions and turn >= _DIVISION_PASS:
            model = fit_divisions(movie, links, middle, float(motion.scale[0]))
        links = _assign(movie, candidates, gain, leave, appear, middle, model, motion, rates)
        if progress is not None:
            progress((turn + 2) * pairs, total)
    assert links is not None
    return Solution(
        links, known, motion, shapes, rates, model, candidates, gain, flow, leave, appear
    )


def nearest_width() -> int:
    from cellquant.track.flow import CANDIDATES

    return CANDIDATES


def _assign(
    movie: Movie,
    candidates: IntArray,
    gain: FloatArray,
    leave: FloatArray,
    appear: FloatArray,
    middle: FloatArray,
    model: Divisions | None,
    motion: Motion,
    rates: Rates,
) -> Links:
    n = movie.n_cells
    after = np.full(n, -1, dtype=np.int64)
    second, before = after.copy(), after.copy()
    confidence = np.zeros(n)
    log_rate = float(np.log(rates.divide))
    for index in range(len(movie.time) - 1):
        a, b = movie.cells_of(index), movie.cells_of(index + 1)
        n_there = b.stop - b.start
        local = np.where(candidates[a] >= 0, candidates[a] - b.start, -1)
        probability = np.empty(local.shape)
        marginals(gain[a], local, n_there, 6, probability)
        row, column = np.nonzero(probability > _UNLIKELY)
        rows, columns = row + a.start, candidates[a][row, column]
        value = gain[a][row, column]
        families = np.empty((0, 3), dtype=np.int64)
        odds = np.empty(0)
        if model is not None:
            reached = np.zeros(n_there)
            np.maximum.at(reached, local[row, column], probability[row, column])
            orphan = np.zeros(n, dtype=np.int64)
            orphan[b] = reached < _SURE
            families, odds = propose(
                movie,
                index,
                candidates,
                orphan,
                middle,
                model,
                float(motion.tail[0]),
                log_rate,
                leave,
                appear,
            )
        chosen, split = match_with_divisions(rows, columns, value, families, odds)
        after[rows[chosen]] = columns[chosen]
        before[columns[chosen]] = rows[chosen]
        confidence[columns[chosen]] = probability[row[chosen], column[chosen]]
        for mother, one, two in families[split]:
            after[mother], second[mother] = one, two
            before[one] = before[two] = mother
        confidence[families[split, 1]] = confidence[families[split, 2]] = 1.0 / (
            1.0 + np.exp(-np.minimum(odds[split], 50.0))
        )
    return Links(after, second, before, confidence)

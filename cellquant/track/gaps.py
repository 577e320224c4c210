"""Gaps: cells that were missed for a few frames, joined by a global pass over the ends."""

import numpy as np

from cellquant.track.assign import match
from cellquant.track.movie import FloatArray, IntArray, Movie
from cellquant.track.near import nearest_cells
from cellquant.track.solve import Solution

_NEAREST = 6
_PRIOR_MISSED = 0.005
_ROUNDS = 3
_DECOYS = 3  # frames beyond the longest gap that show how often strangers fit by chance
_CAUTION = np.log(10.0)


def close_gaps(
    movie: Movie,
    solution: Solution,
    *,
    max_gap: int,
    max_distance: float,
) -> tuple[IntArray, IntArray, FloatArray]:
    """Join ends to starts that lie up to `max_gap` missing frames apart.

    The place is extrapolated with the local flow, its scatter grows as the square root of time,
    and the chance to miss a cell is learned from how many gaps there are. Ends and starts that lie
    farther apart in time than `max_gap` join by chance only, and are subtracted: a movie without
    gaps convinces itself that there are none. A join must be ten times likelier than not.

    Returns
    -------
    end, start : numpy.ndarray
        Cells before and after each gap.
    confidence : numpy.ndarray
        Probability of each join against the two ends being strangers.
    """
    if max_gap == 0:
        none = np.empty(0, dtype=np.int64)
        return none, none, np.empty(0)
    source, target, odds, missing = _candidates(movie, solution, max_gap + _DECOYS, max_distance)
    allowed = missing <= max_gap
    missed = _PRIOR_MISSED
    for _ in range(_ROUNDS):
        joined = missing[match(source, target, odds + np.log(missed))]
        by_chance = float(np.sum(joined > max_gap)) / _DECOYS * max_gap
        found = max(float(np.sum(joined <= max_gap)) - by_chance, 0.0)
        missed = (found + 0.5) / (movie.n_cells + 0.5 / _PRIOR_MISSED)
    total = (odds + np.log(missed))[allowed]
    source, target = source[allowed], target[allowed]
    chosen = match(source, target, total - _CAUTION)
    return source[chosen], target[chosen], 1.0 / (1.0 + np.exp(-np.minimum(total[chosen], 50.0)))


def _candidates(
    movie: Movie, solution: Solution, max_gap: int, max_distance: float
) -> tuple[IntArray, IntArray, FloatArray, IntArray]:
    links, motion, shapes, flow = (solution.links, solution.motion, solution.shapes, solution.flow)
    assert links is not None
    assert solution.fates is not None
    ends_all = np.flatnonzero(links.after < 0)
    starts_all = np.flatnonzero(links.before < 0)
    sources: list[IntArray] = []
    targets: list[IntArray] = []
    values: list[FloatArray] = []
    spans: list[IntArray] = []
    n_frames = len(movie.time)
    ends_of = np.searchsorted(ends_all, movie.start)
    starts_of = np.searchsorted(starts_all, movie.start)
    end, place = np.empty(0, dtype=np.int64), np.empty((0, 2))
    for index in range(n_frames - 2):
        fresh = ends_all[ends_of[index] : ends_of[index + 1]]
        end = np.concatenate((end, fresh))
        place = np.concatenate((place, movie.position[fresh] + flow[fresh]))
        later = index + 2
        span = (movie.time[later] - movie.time[movie.frame_index[end]]).astype(np.float64)
        open_yet = span <= max_gap + 1
        end, place, span = end[open_yet], place[open_yet], span[open_yet]
        if len(end) == 0:
            continue
        # The flow of the missing frame, read where the cells would be.
        bridge = movie.cells_of(later - 1)
        nearest, _ = nearest_cells(place, movie.position[bridge], 1)
        place = place + flow[bridge][nearest[:, 0]]
        starts = starts_all[starts_of[later] : starts_of[later + 1]]
        if len(starts) == 0:
            continue
        k = min(_NEAREST, len(starts))
        found, _ = nearest_cells(place, movie.position[starts], k)
        row = np.repeat(np.arange(len(end)), k)
        a, b, span = end[row], starts[found.reshape(-1)], span[row]
        away = movie.position[b] - place[row]
        raw = np.hypot(*(movie.position[b] - movie.position[a]).T)
        width = motion.scale[0] * span
        nu = motion.tail[0]
        value = -np.log(2 * np.pi * width**2)
        value = value - (nu / 2 + 1) * np.log1p(np.sum(away**2, axis=1) / (nu * width**2))
        value += shapes.odds(a, b) - solution.fates.vanish[a] - solution.fates.appear[b]
        value[raw > max_distance * span] = -np.inf
        sources.append(a)
        targets.append(b)
        values.append(value)
        spans.append(span.astype(np.int64) - 1)
    if not sources:
        none = np.empty(0, dtype=np.int64)
        return none, none, np.empty(0), none
    return (
        np.concatenate(sources),
        np.concatenate(targets),
        np.concatenate(values),
        np.concatenate(spans),
    )

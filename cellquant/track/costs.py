"""What a link is worth: motion, calibrated on the movie itself, and shape."""

from dataclasses import dataclass

import numpy as np

from cellquant.track.fates import Fates
from cellquant.track.motion_kernels import (
    add_weighted,
    link_steps,
    neighbour_mean,
    pair_gains,
    squared_residuals,
    step_ratios,
    steps_ahead,
)
from cellquant.track.movie import LOG_AREA, NEAR, BoolArray, FloatArray, IntArray, Links, Movie
from cellquant.track.shapes import TAIL, Shapes

KINDS = 4  # no path, path after, path before, path on both sides
TERMS = 7
_TAILS = (4.0, 6.0, 8.0, 12.0)  # heavier ones would make room for wrong links
_PRIOR_SPREAD = (20.0, 50.0, 50.0)  # links that say that frames, stirred and edge cells are alike
_SPREAD = (0.2, 5.0)
_SLIVER = 2  # grade of cells of which the edge of the view leaves less than half
_CAREFUL = 5.0  # of log likelihood that speaks against a heavier tail of slivers
_PRIOR_LINKS = 10.0
_FIT_LINKS = 10000  # links that a fit looks at, evenly taken
_PRIOR_FLOW = 0.5  # neighbours that the first guess of the flow counts for
_FIT_ROUNDS, _FIT_ENOUGH = 12, 1e-3  # until the scale changes by less than this share
_COUNTED = 0.02  # probability from which a candidate counts in a fit
_PRIOR_SCALE = 0.15  # of the spacing
_CAUTION = 1.0  # of log likelihood per cell that a wider start may lose
_FIRST_SCALES = np.geomspace(0.03, 2.0, 24)  # of the spacing
_FIRST_CELLS = 5000
_STRAY = 0.1
_DOUBT = 12.0  # of log odds; no shape is compared that could not come so near the likeliest link


@dataclass(frozen=True)
class Paths:
    """Displacements per frame relative to the drift: of the cells and around them.

    ``drift`` (P, 2) of each pair of frames; ``own_after``, ``own_before`` (N, 2) with
    ``has_after``, ``has_before`` (N,); ``around_after`` and ``around_before`` (N, 2, 2) means
    over the neighbours at two scales.
    """

    drift: FloatArray
    own_after: FloatArray
    own_before: FloatArray
    has_after: IntArray
    has_before: IntArray
    around_after: FloatArray
    around_before: FloatArray


@dataclass(frozen=True)
class Motion:
    """Prediction of a displacement from the paths, and the scatter around it, per kind.

    ``coefficients`` (4, 7) of: neighbours now near, neighbours now wide, neighbours before,
    neighbours of the partner now, neighbours of the partner next, own step before, partner's
    step next. ``scale`` (4,) and ``tail`` (4,) of the two-dimensional Student density.
    ``spread`` (N,) says how many times wider it is at each cell: in its frame, where cells die or
    divide beside it, and where the edge of the view cuts it. ``slivers`` (N,), of which that edge
    leaves less than half a cell, have a ``sliver_tail`` of their own.
    """

    coefficients: FloatArray
    scale: FloatArray
    tail: FloatArray
    spread: FloatArray
    slivers: BoolArray
    sliver_tail: float


def paths(movie: Movie, links: Links | None, flow: FloatArray, carried: FloatArray) -> Paths:
    """Collect displacements from links, or from the flow where there are none yet.

    carried (N, 2) is the flow of the frame before, at the cells that it reaches.
    """
    n = movie.n_cells
    drift = np.zeros((len(movie.time), 2))
    per_frame = flow / movie.elapsed[:, None]
    own_after, own_before = np.zeros((n, 2)), np.zeros((n, 2))
    has_after, has_before = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=np.int64)
    left, arrived = np.zeros(n), np.zeros(n)
    around_after, around_before = np.empty((n, 2, 2)), np.empty((n, 2, 2))
    if links is None:
        for index in range(len(movie.time) - 1):
            here = movie.cells_of(index)
            drift[index] = np.median(per_frame[here], axis=0)
            own_after[here] = per_frame[here] - drift[index]
        left[:] = 1.0
    else:
        link_steps(
            movie.position,
            movie.start,
            movie.elapsed,
            links.after,
            links.second,
            links.confidence,
            per_frame,
            drift,
            own_after,
            own_before,
            has_after,
            has_before,
            left,
            arrived,
        )
    before_drift = np.vstack((np.zeros(2), drift[:-1]))
    for displacement, weight, field, shift, mean in (
        (own_after, left, per_frame, drift, around_after),
        (own_before, arrived, carried, before_drift, around_before),
    ):
        neighbour_mean(
            displacement,
            weight,
            movie.neighbours,
            NEAR,
            field,
            shift,
            movie.frame_index,
            _PRIOR_FLOW,
            mean,
        )
    if links is None:
        own_after[:] = 0.0
    return Paths(drift, own_after, own_before, has_after, has_before, around_after, around_before)


def regressors(paths: Paths, source: IntArray, target: IntArray) -> FloatArray:
    """The seven predictors (L, 7, 2) of the displacement from source to target."""
    return np.stack(
        (
            paths.around_after[source, 0],
            paths.around_after[source, 1],
            paths.around_before[source, 0],
            paths.around_before[target, 0],
            paths.around_after[target, 0],
            paths.own_before[source],
            paths.own_after[target],
        ),
        axis=1,
    )


def expected_steps(movie: Movie, paths: Paths, motion: Motion, *, own_path: bool) -> FloatArray:
    """Displacement (N, 2) to the next frame expected of each cell, its partner not yet known."""
    expected = np.empty((movie.n_cells, 2))
    steps_ahead(
        paths.around_after,
        paths.around_before,
        paths.own_before,
        paths.has_before,
        paths.drift,
        movie.frame_index,
        movie.elapsed,
        motion.coefficients,
        own_path,
        expected,
    )
    return expected


def first_motion(movie: Movie, flow: FloatArray, candidates: IntArray) -> Motion:
    """The motion model before anything is linked: neighbours move alike.

    The scatter around the flow is the widest that is not clearly less likely than the likeliest,
    if one of the candidates (N, K) of each cell follows the flow and the others lie anywhere: a
    narrow start trusts the shortest links, and would find that they are short.
    """
    spacing = float(np.median(movie.spacing))
    coefficients = np.zeros((KINDS, TERMS))
    coefficients[:, 0] = 0.5
    coefficients[:, 1] = 0.5
    source = np.flatnonzero(candidates[:, 0] >= 0)
    source = source[:: max(1, len(source) // _FIRST_CELLS)]
    target = candidates[source]
    away = movie.position[target] - (movie.position[source] + flow[source])[:, None]
    square = np.where(target >= 0, np.sum(away**2, axis=2), np.inf)
    likelihood = []
    for scale in (_FIRST_SCALES * spacing).tolist():
        density = (1.0 + square / (4.0 * scale**2)) ** -3 / (2.0 * np.pi * scale**2)
        odds = density.sum(axis=1) / movie.density[source]
        likelihood.append(float(np.mean(np.log(_STRAY + (1.0 - _STRAY) * odds))))
    likely = np.array(likelihood) >= max(likelihood) - _CAUTION
    first = max(float(_FIRST_SCALES[likely][-1]), _PRIOR_SCALE) * spacing
    scale, tail = np.full(KINDS, first), np.full(KINDS, 4.0)
    nobody = np.zeros(movie.n_cells, dtype=np.bool_)
    return Motion(coefficients, scale, tail, np.ones(movie.n_cells), nobody, _TAILS[-1])


def fit_motion(
    movie: Movie,
    links: Links,
    candidates: IntArray,
    probability: FloatArray,
    paths: Paths,
    before: Motion,
) -> Motion:
    """Fit prediction and scatter to the links, robustly, each kind of path by itself.

    The other candidates (N, K) of a linked cell count by their probability: links that were
    chosen because they are short would make steps look shorter than they are.
    """
    row = np.flatnonzero((links.after >= 0) & (links.second < 0))
    row = row[:: max(1, len(row) // _FIT_LINKS)]
    chance = probability[row]
    which, slot = np.nonzero(chance > _COUNTED)
    source, weight = row[which], chance[which, slot]
    target = candidates[source, slot]
    frames = movie.frame_index[source]
    elapsed = movie.elapsed[source]
    step = movie.position[target] - movie.position[source]
    y = step / elapsed[:, None] - paths.drift[frames]
    x = regressors(paths, source, target)
    # A cell's own link is part of the neighbourhood of its neighbours only, never of its own.
    # Residuals grow as the root of time; in these units all have the same scatter.
    unit = 1.0 / (before.spread[source] / np.sqrt(elapsed))
    x, y = x * unit[:, None, None], y * unit[:, None]
    has_before, has_after = paths.has_before[source] == 1, paths.has_after[target] == 1
    coefficients, scale, tail = before.coefficients.copy(), before.scale.copy(), before.tail.copy()
    spacing = float(np.median(movie.spacing))
    for kind in range(KINDS):
        # Cells with a longer path are evidence for the poorer kinds too.
        use = np.ones(len(source), dtype=bool)
        terms = [0, 1, 2, 3, 4]
        if kind & 2:
            use &= has_before
            terms.append(5)
        if kind & 1:
            use &= has_after
            terms.append(6)
        if use.sum() < 4 * TERMS:
            continue
        taken = np.flatnonzero(use)
        taken = taken[:: max(1, len(taken) // _FIT_LINKS)]
        part = x[taken][:, terms]
        found = _student_fit(part, y[taken], weight[taken], before.scale[kind], spacing)
        coefficients[kind] = 0.0
        coefficients[kind, terms], scale[kind], tail[kind] = found
    kinds: IntArray = 2 * paths.has_before[source] + paths.has_after[target]
    rest = y - np.einsum("ltd,lt->ld", x, coefficients[kinds])
    square = np.sum(rest**2, axis=1) * before.spread[source] ** 2 / scale[kinds] ** 2
    at_edge = _at_edge(movie, candidates)
    slivers = at_edge == _SLIVER
    tails = np.where(slivers[source], before.sliver_tail, tail[kinds])
    groups = (movie.frame_index, _stirred(movie, links), at_edge)
    spread = _spread(square, weight, tails, groups, source)
    cut = slivers[source]
    sliver_tail = _tail(square[cut] / spread[source[cut]] ** 2, weight[cut], _CAREFUL)
    return Motion(coefficients, scale, tail, spread, slivers, sliver_tail)


def _tail(square: FloatArray, weight: FloatArray, margin: float) -> float:
    """Lightest tail of the Student density that no other beats by more than `margin`, from
    residuals over the scale, squared (L,). Logarithms of single precision, eight times as fast,
    are exact enough to choose among so few."""
    near, weight = square.astype(np.float32), weight.astype(np.float32)
    one = np.float32(1.0)
    likelihood = [
        -(v / 2 + 1) * float(np.sum(weight * np.log(one + near / np.float32(v)), dtype=np.float64))
        for v in _TAILS
    ]
    best = max(likelihood) - margin
    return max(v for v, value in zip(_TAILS, likelihood, strict=True) if value >= best)


def _at_edge(movie: Movie, candidates: IntArray) -> IntArray:
    """1 for the cells (N,) that the edge of the view cuts now or next, 2 for slivers, of which it
    leaves less than half a usual cell: centroids wander as more or less of a cell is seen."""
    area = movie.shape[:, LOG_AREA]
    grade = np.where(movie.cut, np.where(area < np.median(area) - np.log(2.0), _SLIVER, 1), 0)
    following = np.where(candidates[:, 0] >= 0, grade[candidates[:, 0]], 0)
    found: IntArray = np.maximum(grade, following)
    return found


def _stirred(movie: Movie, links: Links) -> IntArray:
    """1 for the cells (N,) that vanish before the next frame, or lie beside one that vanishes or
    divides."""
    event = (links.after < 0) | (links.second >= 0)
    # Which of two neighbours vanished is often in doubt: both may be the one that moved in.
    found: IntArray = ((links.after < 0) | event[movie.neighbours[:, :NEAR]].any(axis=1)) * 1
    return found


def _spread(
    square: FloatArray,
    weight: FloatArray,
    tail: FloatArray,
    groups: tuple[IntArray, ...],
    source: IntArray,
) -> FloatArray:
    """Factors (N,) on the scale: the product of one of each cell's frame, of its being stirred,
    and of its lying at the edge.

    square (L,) are residuals over the scale, squared, of links that leave `source` (L,). All
    factors come from robust scatter, each drawn towards 1.
    """
    factors = [np.ones(int(group.max()) + 1) for group in groups]
    of_links = [group[source] for group in groups]
    for _ in range(8):
        for factor, group, prior in zip(factors, of_links, _PRIOR_SPREAD, strict=True):
            product = np.ones(len(square))
            for other, place in zip(factors, of_links, strict=True):
                product *= other[place] ** 2
            robust = weight * (tail + 2.0) / (tail + square / product) * square / product / 2
            top = factor**2 * np.bincount(group, robust, len(factor)) + prior
            factor[:] = np.sqrt(top / (np.bincount(group, weight, len(factor)) + prior))
    spread = np.ones(len(groups[0]))
    for factor, group in zip(factors, groups, strict=True):
        spread *= factor[group]
    return np.clip(spread, *_SPREAD)


def _student_fit(
    x: FloatArray, y: FloatArray, weight: FloatArray, scale: float, spacing: float
) -> tuple[FloatArray, float, float]:
    """Regression with two-dimensional Student errors: coefficients, scale, degrees of freedom."""
    terms = x.shape[1]
    flat, goal = np.ascontiguousarray(x.transpose(0, 2, 1)).reshape(-1, terms), y.reshape(-1)
    nu = 4.0
    ridge = _PRIOR_LINKS * scale**2 * np.eye(terms) / (0.3 * spacing) ** 2
    start = np.zeros(terms)
    start[0] = start[1] = 0.5
    coefficient = start
    prior_scale = (_PRIOR_SCALE * spacing) ** 2
    total = weight.sum() + _PRIOR_LINKS
    square = np.empty(len(y))
    squared_residuals(flat, goal, coefficient, square)
    for _ in range(_FIT_ROUNDS):
        before = (scale, nu)
        normal, right = ridge.copy(), ridge @ start
        robust = weight * (nu + 2.0) / (nu + square / scale**2)
        add_weighted(flat, goal, robust, normal, right)
        coefficient = np.asarray(np.linalg.solve(normal, right), dtype=np.float64)
        squared_residuals(flat, goal, coefficient, square)
        robust = weight * (nu + 2.0) / (nu + square / scale**2)
        scale = float(np.sqrt((robust @ square / 2 + _PRIOR_LINKS * prior_scale) / total))
        scale = max(scale, 1e-3 * spacing)
        far = square / scale**2
        nu = _tail(far, weight, 0.0)
        if nu == before[1] and abs(scale - before[0]) < _FIT_ENOUGH * scale:
            break
    return coefficient, scale, nu


def gains(
    movie: Movie,
    candidates: IntArray,
    paths: Paths,
    motion: Motion,
    shapes: Shapes,
    fates: Fates,
    max_distance: float,
) -> FloatArray:
    """Log odds (N, K) of the candidate links.

    The logarithms of the step are of single precision, several times as fast: 1e-5 of log odds.
    """
    spread = motion.spread * np.sqrt(movie.elapsed)
    ratio = np.empty(candidates.shape, dtype=np.float32)
    step_ratios(
        movie.position,
        candidates,
        movie.elapsed,
        spread,
        paths.own_before,
        paths.own_after,
        paths.has_before,
        paths.has_after,
        paths.around_after,
        paths.around_before,
        paths.drift,
        movie.frame_index,
        motion.coefficients,
        motion.scale,
        motion.tail,
        motion.slivers,
        motion.sliver_tail,
        max_distance,
        ratio,
    )
    gain = np.empty(candidates.shape)
    shape = shapes.population.centred @ np.linalg.cholesky(shapes.precision)
    expected = (shapes.memory * shapes.population.centred) @ np.linalg.cholesky(shapes.precision)
    pair_gains(
        np.log(ratio, out=ratio),
        movie.cut,
        candidates,
        spread,
        paths.has_before,
        paths.has_after,
        motion.scale,
        motion.tail,
        motion.slivers,
        motion.sliver_tail,
        shape,
        expected,
        shapes.spread,
        shapes.informative,
        shapes.constant + shapes.population.unlike,
        TAIL,
        fates.stay,
        fates.vanish,
        fates.appear,
        _DOUBT,
        gain,
    )
    return gain

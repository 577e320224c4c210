"""What a link is worth: motion and shape, calibrated on the movie itself."""

from dataclasses import dataclass

import numpy as np

from cellquant.track.fates import Fates
from cellquant.track.kernels import neighbour_mean, pair_gains
from cellquant.track.movie import NEAR, FloatArray, IntArray, Links, Movie

KINDS = 4  # no path, path after, path before, path on both sides
TERMS = 7
_TAILS = (4.0, 6.0, 8.0, 12.0)  # heavier ones would make room for wrong links
_PRIOR_FRAME, _PRIOR_STIRRED = 20.0, 50.0  # links that say that frames and places are alike
_SPREAD = (0.2, 5.0)
_SHAPE_TAIL = 5.0
_SHAPE_FLOOR = 0.05
_PRIOR_LINKS = 10.0
_PRIOR_INFORMATIVE = 0.9
_FIT_LINKS = 10000  # links that a fit looks at, evenly taken
_PRIOR_SCALE = 0.15  # of the spacing


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
    ``spread`` (N,) says how many times wider it is at each cell: in its frame, and where cells
    die or divide beside it.
    """

    coefficients: FloatArray
    scale: FloatArray
    tail: FloatArray
    spread: FloatArray


@dataclass(frozen=True)
class Shapes:
    """How much of a cell's shape survives a frame, against the spread in the population.

    ``spread`` (N,) says how many times wider the change is at each cell;
    ``informative`` (N,) is the chance that its next shape tells more than that of any cell.
    """

    typical: FloatArray
    memory: FloatArray
    link_precision: FloatArray
    population_precision: FloatArray
    constant: float
    spread: FloatArray
    informative: FloatArray


def paths(movie: Movie, links: Links | None, flow: FloatArray, carried: FloatArray) -> Paths:
    """Collect displacements from links, or from the flow where there are none yet.

    carried (N, 2) is the flow of the frame before, at the cells that it reaches.
    """
    n = movie.n_cells
    frames = movie.frame_index
    elapsed = movie.elapsed
    drift = np.zeros((len(movie.time), 2))
    per_frame = flow / elapsed[:, None]
    own_after, own_before = np.zeros((n, 2)), np.zeros((n, 2))
    has_after, has_before = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=np.int64)
    if links is None:
        weight = np.ones(n)
        moved = per_frame.copy()
    else:
        single = np.flatnonzero((links.after >= 0) & (links.second < 0))
        target = links.after[single]
        moved = np.zeros((n, 2))
        moved[single] = (movie.position[target] - movie.position[single]) / elapsed[single, None]
        weight = np.zeros(n)
        weight[single] = links.confidence[target]
        has_after[single] = 1
        has_before[target] = 1
    for index in range(len(movie.time) - 1):
        here = movie.cells_of(index)
        used = weight[here] > 0.3
        source = moved[here][used] if used.sum() >= 3 else per_frame[here]
        drift[index] = np.median(source, axis=0)
    relative = moved - drift[frames]
    before_drift = np.vstack((np.zeros(2), drift[:-1]))[frames]
    fallback = per_frame - drift[frames]
    fallback[movie.start[-2] :] = 0.0
    around_after = np.empty((n, 2, 2))
    neighbour_mean(relative, weight, movie.neighbours, NEAR, fallback, 0.5, around_after)
    around_before = np.zeros((n, 2, 2))
    if links is None:
        around_before = np.repeat((carried - before_drift)[:, None], 2, axis=1)
    else:
        own_after[single] = relative[single]
        own_before[target] = relative[single]
        arrived = np.zeros(n)
        arrived[target] = weight[single]
        neighbour_mean(
            own_before, arrived, movie.neighbours, NEAR, carried - before_drift, 0.5, around_before
        )
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
    frames = movie.frame_index
    elapsed = movie.elapsed
    kind = 2 * paths.has_before if own_path else np.zeros(movie.n_cells, dtype=np.int64)
    weight = motion.coefficients[kind]
    # What the partner's neighbourhood does now is what the own neighbourhood does now.
    step = (weight[:, 0] + weight[:, 3])[:, None] * paths.around_after[:, 0]
    step = step + weight[:, 1, None] * paths.around_after[:, 1]
    step += weight[:, 2, None] * paths.around_before[:, 0] + weight[:, 5, None] * paths.own_before
    expected: FloatArray = (paths.drift[frames] + step) * elapsed[:, None]
    return expected


def first_motion(movie: Movie) -> Motion:
    """The motion model before anything is known: neighbours move alike."""
    spacing = float(np.median(movie.spacing))
    coefficients = np.zeros((KINDS, TERMS))
    coefficients[:, 0] = 0.5
    coefficients[:, 1] = 0.5
    scale, tail = np.full(KINDS, _PRIOR_SCALE * spacing), np.full(KINDS, 4.0)
    return Motion(coefficients, scale, tail, np.ones(movie.n_cells))


def fit_motion(movie: Movie, links: Links, paths: Paths, before: Motion) -> Motion:
    """Fit prediction and scatter to the links, robustly, each kind of path by itself."""
    source = np.flatnonzero((links.after >= 0) & (links.second < 0))
    source = source[:: max(1, len(source) // _FIT_LINKS)]
    target = links.after[source]
    frames = movie.frame_index[source]
    elapsed = movie.elapsed[source]
    step = movie.position[target] - movie.position[source]
    y = step / elapsed[:, None] - paths.drift[frames]
    x = regressors(paths, source, target)
    # A cell's own link is part of the neighbourhood of its neighbours only, never of its own.
    weight = links.confidence[target]
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
    stirred = _stirred(movie, links)
    spread = _spread(square, weight, tail[kinds], frames, stirred[source], len(movie.time))
    return Motion(coefficients, scale, tail, spread[movie.frame_index, stirred])


def _stirred(movie: Movie, links: Links) -> IntArray:
    """1 for the cells (N,) that vanish before the next frame, or lie beside one that vanishes or
    divides."""
    event = (links.after < 0) | (links.second >= 0)
    # Which of two neighbours vanished is often in doubt: both may be the one that moved in.
    found: IntArray = ((links.after < 0) | event[movie.neighbours[:, :NEAR]].any(axis=1)) * 1
    return found


def _bereft(movie: Movie, links: Links) -> IntArray:
    """1 for the cells (N,) that vanish before the next frame, or lie beside one that does."""
    gone = links.after < 0
    found: IntArray = (gone | gone[movie.neighbours[:, :NEAR]].any(axis=1)) * 1
    return found


def _spread(
    square: FloatArray,
    weight: FloatArray,
    tail: FloatArray,
    frame: IntArray,
    stirred: IntArray,
    n_frames: int,
) -> FloatArray:
    """Factors (P, 2) on the scale for each frame, calm and stirred.

    square (L,) are residuals over the scale, squared. Both kinds of factor come from robust
    scatter, each drawn towards 1.
    """
    by_frame, by_stir = np.ones(n_frames), np.ones(2)
    for _ in range(8):
        for factor, group, prior in (
            (by_stir, stirred, _PRIOR_STIRRED),
            (by_frame, frame, _PRIOR_FRAME),
        ):
            width = (by_frame[frame] * by_stir[stirred]) ** 2
            robust = weight * (tail + 2.0) / (tail + square / width) * square / width / 2
            top = factor**2 * np.bincount(group, robust, len(factor)) + prior
            factor[:] = np.sqrt(top / (np.bincount(group, weight, len(factor)) + prior))
    spread: FloatArray = np.clip(by_frame[:, None] * by_stir, *_SPREAD)
    return spread


def _student_fit(
    x: FloatArray, y: FloatArray, weight: FloatArray, scale: float, spacing: float
) -> tuple[FloatArray, float, float]:
    """Regression with two-dimensional Student errors: coefficients, scale, degrees of freedom."""
    terms = x.shape[1]
    flat, goal = x.transpose(0, 2, 1).reshape(-1, terms), y.reshape(-1)
    nu = 4.0
    ridge = _PRIOR_LINKS * scale**2 * np.eye(terms) / (0.3 * spacing) ** 2
    start = np.zeros(terms)
    start[0] = start[1] = 0.5
    coefficient = start
    prior_scale = (_PRIOR_SCALE * spacing) ** 2
    for _ in range(12):
        r2 = np.sum((y - np.einsum("ltd,t->ld", x, coefficient)) ** 2, axis=1)
        w = weight * (nu + 2.0) / (nu + r2 / scale**2)
        w2 = np.repeat(w, 2)
        normal = flat.T @ (w2[:, None] * flat) + ridge
        coefficient = np.linalg.solve(normal, flat.T @ (w2 * goal) + ridge @ start)
        r2 = np.sum((y - np.einsum("ltd,t->ld", x, coefficient)) ** 2, axis=1)
        w = weight * (nu + 2.0) / (nu + r2 / scale**2)
        total = weight.sum() + _PRIOR_LINKS
        scale = float(np.sqrt((np.sum(w * r2) / 2 + _PRIOR_LINKS * prior_scale) / total))
        scale = max(scale, 1e-3 * spacing)
        likelihood = [np.sum(weight * -(v / 2 + 1) * np.log1p(r2 / (v * scale**2))) for v in _TAILS]
        nu = _TAILS[int(np.argmax(likelihood))]
    return coefficient, scale, nu


def fit_shapes(movie: Movie, links: Links | None) -> Shapes:
    """Fit the change of shape along links and the spread of shapes in the population."""
    source = target = np.empty(0, dtype=np.int64)
    weight = np.empty(0)
    if links is not None:
        source = np.flatnonzero((links.after >= 0) & (links.second < 0))
        target = links.after[source]
        weight = links.confidence[target]
    shape = movie.shape
    f = shape.shape[1]
    typical = np.median(shape, axis=0)
    typical[1:3] = 0.0
    whole = ~movie.cut
    if whole.any():
        typical[[0, 3]] = np.median(shape[whole][:, [0, 3]], axis=0)
    kept = whole[source] & whole[target]
    source, target, weight = source[kept], target[kept], weight[kept]
    thin = max(1, len(source) // _FIT_LINKS)
    source, target, weight = source[::thin], target[::thin], weight[::thin]
    centred = shape - typical
    floor = _SHAPE_FLOOR**2 * np.eye(f)
    population = _robust_covariance(centred[whole], np.ones(int(whole.sum()))) + floor
    if links is None or len(source) < 10 * f:
        precision = np.asarray(np.linalg.inv(population), dtype=np.float64)
        same = np.ones(movie.n_cells)
        return Shapes(typical, np.zeros(f), precision, precision, 0.0, same, same)
    a, b = centred[source], centred[target]
    w = weight[:, None]
    # Elongation is a vector: both components share one memory.
    top, bottom = np.sum(w * a * b, axis=0), np.sum(w * a * a, axis=0) + len(source) * floor[0, 0]
    top[1:3], bottom[1:3] = top[1:3].sum(), bottom[1:3].sum()
    memory = np.clip(top / bottom, 0.0, 1.0)
    rest = b - memory * a
    change = _robust_covariance(rest, weight) + floor
    link_precision = np.asarray(np.linalg.inv(change), dtype=np.float64)
    population_precision = np.asarray(np.linalg.inv(population), dtype=np.float64)
    constant = 0.5 * (np.linalg.slogdet(population)[1] - np.linalg.slogdet(change)[1])
    square = np.einsum("nf,fg,ng->n", rest, link_precision, rest)
    # A cell that grows into the place of another may take any shape.
    bereft = _bereft(movie, links)
    beside = bereft[source] == 1
    spread = np.where(bereft == 1, _widening(square[beside], weight[beside], f), 1.0)
    near = square / spread[source] ** 2
    far = np.einsum("nf,fg,ng->n", b, population_precision, b)
    odds = constant - f * np.log(spread[source])
    odds -= (_SHAPE_TAIL + f) / 2 * (np.log1p(near / _SHAPE_TAIL) - np.log1p(far / _SHAPE_TAIL))
    informative = np.where(bereft == 1, _informative(odds[beside], weight[beside]), 1.0)
    return Shapes(
        typical,
        memory,
        link_precision,
        population_precision,
        float(constant),
        spread,
        informative,
    )


def _widening(square: FloatArray, weight: FloatArray, f: int) -> float:
    """How many times wider (at least 1) the change of f descriptors is, from squares (L,)."""
    width = 1.0
    for _ in range(10):
        robust = weight * (_SHAPE_TAIL + f) / (_SHAPE_TAIL + square / width) * square / f
        width = (float(robust.sum()) + _PRIOR_STIRRED) / (float(weight.sum()) + _PRIOR_STIRRED)
    return float(np.sqrt(np.clip(width, 1.0, _SPREAD[1] ** 2)))


def _informative(odds: FloatArray, weight: FloatArray) -> float:
    """Share of links whose shapes follow the law of links, by expectation maximisation.

    odds (L,) log odds of that law against any two cells.
    """
    ratio = np.exp(np.clip(odds, -50.0, 50.0))
    share = _PRIOR_INFORMATIVE
    for _ in range(20):
        found = share * ratio / (share * ratio + 1.0 - share)
        total = float(np.sum(weight * found)) + _PRIOR_LINKS * _PRIOR_INFORMATIVE
        share = total / (float(weight.sum()) + _PRIOR_LINKS)
    return share


def _robust_covariance(values: FloatArray, weight: FloatArray) -> FloatArray:
    f = values.shape[1]
    if len(values) == 0:
        return np.eye(f)
    thin = max(1, len(values) // (2 * _FIT_LINKS))
    values, weight = values[::thin], weight[::thin]
    covariance = np.diag(np.average(values**2, axis=0, weights=weight) + 1e-9)
    for _ in range(6):
        d = np.einsum("nf,fg,ng->n", values, np.linalg.inv(covariance), values)
        w = weight * (_SHAPE_TAIL + f) / (_SHAPE_TAIL + d)
        covariance = (w[:, None] * values).T @ values / weight.sum() + 1e-9 * np.eye(f)
    return np.asarray(covariance, dtype=np.float64)


def gains(
    movie: Movie,
    candidates: IntArray,
    paths: Paths,
    motion: Motion,
    shapes: Shapes,
    fates: Fates,
    max_distance: float,
) -> FloatArray:
    """Log odds (N, K) of the candidate links."""
    frames = movie.frame_index
    elapsed = movie.elapsed
    gain = np.empty(candidates.shape)
    around = np.stack(
        (paths.around_after[:, 0], paths.around_after[:, 1], paths.around_before[:, 0]), axis=1
    )
    around_target = np.stack((paths.around_before[:, 0], paths.around_after[:, 0]), axis=1)
    centred = movie.shape - shapes.typical
    root = np.linalg.cholesky(shapes.link_precision)
    far = np.sum((centred @ np.linalg.cholesky(shapes.population_precision)) ** 2, axis=1)
    half = (_SHAPE_TAIL + centred.shape[1]) / 2
    unlike = shapes.constant + half * np.log1p(far / _SHAPE_TAIL)
    pair_gains(
        movie.position,
        movie.cut,
        candidates,
        elapsed,
        motion.spread * np.sqrt(elapsed),
        paths.own_before,
        paths.own_after,
        paths.has_before,
        paths.has_after,
        np.ascontiguousarray(around),
        paths.drift[frames],
        np.ascontiguousarray(around_target),
        motion.coefficients,
        motion.scale,
        motion.tail,
        centred @ root,
        (shapes.memory * centred) @ root,
        shapes.spread,
        shapes.informative,
        unlike,
        _SHAPE_TAIL,
        fates.stay,
        fates.vanish,
        fates.appear,
        max_distance,
        gain,
    )
    return gain

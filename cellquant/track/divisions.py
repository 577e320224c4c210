"""Divisions: one mother, two daughters, judged by place, distance and sizes; and broken masks."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter1d

from cellquant.track.family_kernels import division_gains
from cellquant.track.movie import LOG_AREA, BoolArray, FloatArray, IntArray, Links, Movie

_PRIOR_DIVISIONS = 10.0
_PER_MOTHER = 3
_STRETCH_FLOOR = 0.1
_LEAST = 6.0
_SIZE_BLUR = 0.1  # of the logarithm of the area
_RARE = 1e-4
_PATCH_FRAMES = 3  # for which a mask may be broken
_PATCHED = 0.25  # of the logarithm of the area, by which a mask that was mended may differ
_ENOUGH_BROKEN, _BROKEN_SHARE = 10, 0.1  # families that speak for masks that break
_INFORMATIVE = 0.5  # first guess of the chance that sizes tell a family
_COUNTED = 0.02  # chance from which a family counts in a fit


@dataclass(frozen=True)
class Divisions:
    """Log-normal daughters: mean and deviation of each quantity, for M kinds of family.

    The first kind are divisions of cells that are seen whole; the second divisions at the edge of
    the view, which cuts the mother or a daughter, so that their sizes and the elongation of those
    that are cut tell nothing; the third, where there are enough of them, masks that are broken in
    two for a few frames. ``separation`` (M, 2) of the logarithm of the daughters' distance over
    the root of their summed area; ``ratios`` (M, 4) mean and deviation of the logarithm of their
    summed area over the mother's, deviation of the logarithm of their ratio, and the chance that
    these sizes say more than those of any two cells; ``stretch`` (M, 3, 3) elongation of mother,
    daughters and any cell along the daughters' line, its width, and the width across; ``width``
    (M,) of the place of their middle; ``population`` (N,) log frequency of each cell's size among
    all cells; ``log_broken`` chance of a mask to break.
    """

    separation: FloatArray
    ratios: FloatArray
    stretch: FloatArray
    width: FloatArray
    population: FloatArray
    log_broken: float


@dataclass(frozen=True)
class Families:
    """Mothers and two daughters each, as indices into all cells (F, 3).

    ``weight`` (F,) chance that each is one, given the links it competes with; ``chosen`` (F,)
    whether it was taken.
    """

    cells: IntArray
    weight: FloatArray
    chosen: BoolArray

    def __getitem__(self, rows: BoolArray) -> "Families":
        return Families(self.cells[rows], self.weight[rows], self.chosen[rows])


def no_families() -> Families:
    """Nobody has divided."""
    return Families(np.empty((0, 3), dtype=np.int64), np.empty(0), np.empty(0, dtype=np.bool_))


def weigh(
    cells: IntArray,
    odds: FloatArray,
    split: IntArray,
    source: IntArray,
    target: IntArray,
    held: FloatArray,
    candidates: IntArray,
    gain: FloatArray,
) -> Families:
    """Chance of every family against the links, or the family, that were chosen in its stead.

    A chosen family is weighed against its better link. Hard counts would find that divisions are
    rare where they were missed, and miss them again.

    Parameters
    ----------
    cells, odds
        Families (F, 3) and their log odds (F,).
    split
        Indices of the chosen families.
    source, target, held
        (L,) ends of the chosen links, and their log odds.
    candidates, gain
        (N, K) candidate links and their log odds.
    """
    n = len(candidates)
    chosen = np.zeros(len(cells), dtype=np.bool_)
    chosen[split] = True

    def worth(one: IntArray, two: IntArray) -> FloatArray:
        found = np.where(candidates[one] == two[:, None], gain[one], -np.inf).max(axis=1)
        return np.asarray(np.maximum(found, 0.0), dtype=np.float64)

    # What each cell holds; a family that takes it away loses that, once per link or family.
    out, into, partner = np.zeros(n), np.zeros(n), np.full(n, -1, dtype=np.int64)
    out[source] = into[target] = np.maximum(held, 0.0)
    partner[source] = target
    for role, column in ((out, 0), (into, 1), (into, 2)):
        role[cells[split, column]] = odds[split]
    mother, one, two = cells.T
    link_one, link_two = worth(mother, one), worth(mother, two)
    lost = out[mother]
    for daughter in (one, two):
        lost = lost + np.where(partner[mother] == daughter, 0.0, into[daughter])
    lost = np.where(chosen, np.maximum(link_one, link_two), lost)
    better = np.exp(np.clip(odds - lost, -50.0, 50.0))
    # Those that were not chosen share the chance of the cells that they have in common.
    rivals = np.where(chosen, 0.0, better)
    shared = np.zeros(len(cells))
    for column in (mother, one, two):
        shared = np.maximum(shared, np.bincount(column, rivals, n)[column])
    weight: FloatArray = np.where(chosen, 1.0, better / (1.0 + shared))
    keep = weight > _COUNTED
    return Families(cells[keep], weight[keep], chosen[keep])


def broken_masks(movie: Movie, links: Links, cells: IntArray) -> IntArray:
    """The daughter (F,) that is left where the daughters of families (F, 3) are soon one cell
    again, as large as both; -1 where they are not.

    One of them ends within three frames, and the next cell of the other is as large as both.
    """
    size = np.exp(movie.shape[:, LOG_AREA])
    _, one, two = cells.T
    left = np.full(len(cells), -1, dtype=np.int64)
    a, b = one, two
    for _ in range(_PATCH_FRAMES):
        for stays, first, ends in ((a, one, b), (b, two, a)):
            following = links.after[stays]
            whole = (following >= 0) & (links.after[ends] < 0) & (left < 0)
            whole &= (stays >= 0) & (ends >= 0) & (links.second[stays] < 0)
            change = np.abs(np.log(size[following] / (size[stays] + size[ends])))
            left = np.where(whole & (change < _PATCHED), first, left)
        a, b = (np.where((c >= 0) & (links.second[c] < 0), links.after[c], -1) for c in (a, b))
    return left


def are_broken(movie: Movie, links: Links, families: Families) -> BoolArray:
    """Whether the masks of the families (F,) fall apart for a while; nobody's where that is rare,
    since a daughter may also be lost by chance."""
    found = broken_masks(movie, links, families.cells) >= 0
    whole = ~movie.cut[families.cells].any(axis=1)
    found &= whole
    number, total = float(families.weight[found].sum()), float(families.weight[whole].sum())
    return found & (number >= max(_ENOUGH_BROKEN, _BROKEN_SHARE * total))


def fit_divisions(
    movie: Movie,
    families: Families,
    broken: BoolArray,
    middle: FloatArray,
    population: FloatArray,
    *,
    spread: FloatArray,
    width: float,
    tail: float,
) -> Divisions:
    """Estimate the daughters' geometry from the families found, with a weak general prior.

    `broken` (F,) are families that are one cell again. `population` (N,) is the `log_frequency` of
    the cells' sizes. `width`, `tail` and `spread` (N,) are those of single cells' steps around
    `middle` (N, 2), where they are expected.
    """
    number = float(families.weight[broken].sum())
    at_edge: BoolArray = np.asarray(movie.cut[families.cells].any(axis=1))
    centre = float(np.median(movie.shape[:, LOG_AREA]))
    apart = float(np.log(0.85 * np.median(movie.spacing)) - centre / 2 - 0.15)

    def fit(kind: BoolArray, prior: _Kind) -> _Kind:
        return _fit_kind(movie, families[kind], middle, population, spread, tail, prior)

    general = _Kind((apart, 0.3), (0.3, 0.35), 0.3, _INFORMATIVE, 1.5 * width)
    whole = fit(~broken & ~at_edge, general)
    # Those at the edge are few, and much of what is seen of them is like the others.
    seen = replace(whole, informative=_INFORMATIVE)
    kinds = [whole, fit(at_edge, seen)]
    stretch = [_fit_stretch(movie, families[~broken & ~at_edge])] * 2
    if broken.any():
        kinds.append(fit(broken, general))
        stretch.append(_fit_stretch(movie, families[broken]))
    return Divisions(
        separation=np.array([kind.separation for kind in kinds]),
        ratios=np.array([(*kind.total, kind.uneven, kind.informative) for kind in kinds]),
        stretch=np.array(stretch),
        width=np.array([kind.width for kind in kinds]),
        population=population,
        log_broken=float(np.log((number + 0.5) / (movie.n_cells + 1.0))),
    )


@dataclass(frozen=True)
class _Kind:
    """Laws of one kind of family; `Divisions` holds those of all."""

    separation: tuple[float, float]
    total: tuple[float, float]
    uneven: float
    informative: float
    width: float


def _fit_kind(
    movie: Movie,
    families: Families,
    middle: FloatArray,
    population: FloatArray,
    spread: FloatArray,
    tail: float,
    prior: _Kind,
) -> _Kind:
    (mother, one, two), weight = families.cells.T, families.weight
    area = movie.shape[:, LOG_AREA]
    both = np.logaddexp(area[one], area[two])
    cut = movie.cut[families.cells].any(axis=1)
    # Where the edge hides a part, the greater of mother and daughters says most of their size.
    size = np.where(cut, np.maximum(both, area[mother]), both)
    apart = np.log(np.hypot(*(movie.position[one] - movie.position[two]).T)) - size / 2
    total = both - area[mother]
    ratio = area[one] - area[two]
    total_fit = _normal(total, weight, *prior.total, 0.1)
    uneven = _normal(ratio, weight, 0.0, prior.uneven, 0.1, fixed=True)[1]
    # How often the sizes of daughters are told better by these laws than by the population.
    family = _log_normal(total, *total_fit) + _log_normal(ratio, 0.0, uneven)
    family -= population[one] + population[two]
    ratio_of = np.exp(np.clip(family, -50.0, 50.0))
    informative = prior.informative
    for _ in range(20):
        share = informative * ratio_of / (informative * ratio_of + 1.0 - informative)
        informative = (float(weight @ share) + 1.0) / (float(weight.sum()) + 2.0)
    place = (movie.position[one] + movie.position[two]) / 2 - middle[mother]
    square = np.sum(place**2, axis=1) / spread[mother] ** 2
    return _Kind(
        _normal(apart, weight, *prior.separation, 0.1),
        total_fit,
        uneven,
        informative,
        _robust_width(square, weight, prior.width, tail),
    )


def _robust_width(square: FloatArray, each: FloatArray, prior: float, tail: float) -> float:
    """Scale of a two-dimensional Student density from squared distances (D,), weighted."""
    width = prior
    for _ in range(10):
        weight = each * (tail + 2.0) / (tail + square / width**2)
        total = np.sum(weight * square) / 2 + _PRIOR_DIVISIONS * prior**2
        width = float(np.sqrt(total / (each.sum() + _PRIOR_DIVISIONS)))
    return width


def _fit_stretch(movie: Movie, families: Families) -> FloatArray:
    (mother, one, two), weight = families.cells.T, families.weight
    elongation = movie.shape[:, 1:3]
    width = max(float(np.sqrt(np.mean(elongation**2))), _STRETCH_FLOOR)
    line = movie.position[two] - movie.position[one]
    angle = 2.0 * np.arctan2(line[:, 1], line[:, 0])
    along = np.column_stack((np.cos(angle), np.sin(angle)))
    across = np.column_stack((-np.sin(angle), np.cos(angle)))
    stretch = np.array([[0.0, width, width]] * 3)
    for role, cells in ((0, (mother,)), (1, (one, two))):
        e = np.concatenate([np.sum(along * elongation[c], axis=1) for c in cells])
        o = np.concatenate([np.sum(across * elongation[c], axis=1) for c in cells])
        each = np.tile(weight, len(cells))
        stretch[role, :2] = _normal(e, each, 0.0, width, _STRETCH_FLOOR)
        stretch[role, 2] = _normal(o, each, 0.0, width, _STRETCH_FLOOR, fixed=True)[1]
    return stretch


def _normal(
    values: FloatArray,
    weight: FloatArray,
    mean: float,
    deviation: float,
    floor: float,
    *,
    fixed: bool = False,
) -> tuple[float, float]:
    n = float(weight.sum()) + _PRIOR_DIVISIONS
    centre = mean if fixed else (float(weight @ values) + _PRIOR_DIVISIONS * mean) / n
    square = float(weight @ (values - centre) ** 2)
    return centre, max(float(np.sqrt((square + _PRIOR_DIVISIONS * deviation**2) / n)), floor)


def size_frequencies(movie: Movie) -> FloatArray:
    """Log density (N,) of the logarithm of each cell's area, among the cells that the edge cuts
    and among the others."""
    area = movie.shape[:, LOG_AREA]
    found = np.empty(movie.n_cells)
    for kind in (movie.cut, ~movie.cut):
        if kind.any():
            found[kind] = _log_frequency(area[kind])
    return found


def _log_frequency(values: FloatArray) -> FloatArray:
    """Log density (N,) of each value among all of them.

    Counted, not assumed normal: a merged or broken cell is as rare as there are such cells, and
    no more.
    """
    low, high = values.min() - 5 * _SIZE_BLUR, values.max() + 5 * _SIZE_BLUR
    count, edges = np.histogram(
        values, max(int((high - low) / (0.25 * _SIZE_BLUR)), 1), (low, high)
    )
    step = edges[1] - edges[0]
    density = gaussian_filter1d(count / (len(values) * step), _SIZE_BLUR / step, mode="constant")
    found = np.interp(values, (edges[:-1] + edges[1:]) / 2, density)
    return np.asarray(np.log(found + _RARE), dtype=np.float64)


def _log_normal(values: FloatArray, mean: float, deviation: float) -> FloatArray:
    density: FloatArray = -0.5 * ((values - mean) / deviation) ** 2 - np.log(
        deviation * np.sqrt(2.0 * np.pi)
    )
    return density


def propose(
    movie: Movie,
    candidates: IntArray,
    orphan: BoolArray,
    middle: FloatArray,
    model: Divisions,
    spread: FloatArray,
    tail: float,
    log_rate: FloatArray,
    leave: FloatArray,
    appear: FloatArray,
) -> tuple[IntArray, FloatArray]:
    """Divisions that are likelier than three single cells, or nearly so.

    Returns (mother, daughter, daughter) as indices into all cells, at most three per mother, best
    first, and their log odds.
    """
    least = -_LEAST  # an image cue can still speak for it
    cells = np.empty((_PER_MOTHER * movie.n_cells, 3), dtype=np.int64)
    gain = np.empty(len(cells))
    kinds = len(model.width)
    prior = np.empty((kinds, movie.n_cells))
    prior[:2] = log_rate
    prior[2:] = model.log_broken
    found = division_gains(
        movie.position,
        movie.shape,
        movie.cut,
        candidates,
        orphan,
        middle,
        model.width[:, None] * spread,
        tail,
        model.separation,
        model.ratios,
        model.population,
        model.stretch,
        prior,
        leave,
        appear,
        least,
        _PER_MOTHER,
        cells,
        gain,
    )
    return cells[:found].copy(), gain[:found].copy()

"""How much of a cell's shape survives a frame, calibrated on the movie itself."""

from dataclasses import dataclass

import numpy as np

from cellquant.track.movie import NEAR, FloatArray, IntArray, Links, Movie

TAIL = 5.0  # degrees of freedom of the Student density of a change of shape
_FLOOR = 0.05
_FIT = 10000  # links, and twice as many cells, that a fit looks at, evenly taken
_PRIOR_LINKS = 10.0
_PRIOR_INFORMATIVE = 0.9
_PRIOR_BESIDE = 50.0  # links that say that shapes change alike everywhere
_WIDEST = 5.0


@dataclass(frozen=True)
class Population:
    """The shapes of all cells, whoever is linked to whom.

    ``centred`` (N, F) descriptors about the typical cell; ``precision`` (F, F) of their scatter,
    ``log_volume`` the logarithm of its determinant's inverse root, ``unlike`` (N,) the negative
    logarithm of the Student density of each, up to a constant.
    """

    centred: FloatArray
    precision: FloatArray
    log_volume: float
    unlike: FloatArray


@dataclass(frozen=True)
class Shapes:
    """Change of shape along links, against the spread in the population.

    ``memory`` (F,) share of a descriptor that is kept, ``precision`` (F, F) of the rest,
    ``constant`` the log ratio of both densities at their peaks. ``spread`` (N,) says how many
    times wider the change is at each cell; ``informative`` (N,) is the chance that its next shape
    tells more than that of any cell.
    """

    population: Population
    memory: FloatArray
    precision: FloatArray
    constant: float
    spread: FloatArray
    informative: FloatArray

    def odds(self, source: IntArray, target: IntArray) -> FloatArray:
        """Log odds (L,) that the shapes belong to one cell rather than to two."""
        b = self.population.centred[target]
        f = b.shape[1]
        change = b - self.memory * self.population.centred[source]
        near = _squares(change, self.precision) / self.spread[source] ** 2
        odds: FloatArray = self.constant - f * np.log(self.spread[source])
        odds += self.population.unlike[target] - (TAIL + f) / 2 * np.log1p(near / TAIL)
        known = self.informative[source]
        mixed: FloatArray = np.log(1.0 - known + known * np.exp(odds))
        return mixed


def population_of(movie: Movie) -> Population:
    """Centre and scatter of all shapes; of whole cells where there are any."""
    shape = movie.shape
    f = shape.shape[1]
    whole = np.flatnonzero(~movie.cut)
    if len(whole) == 0:
        whole = np.arange(len(shape))
    typical = np.zeros(f)
    typical[[0, 3]] = np.median(shape[whole][:, [0, 3]], axis=0)
    centred = shape - typical
    thin = centred[whole[:: max(1, len(whole) // (2 * _FIT))]]
    covariance = _robust_covariance(thin, np.ones(len(thin))) + _FLOOR**2 * np.eye(f)
    precision = np.asarray(np.linalg.inv(covariance), dtype=np.float64)
    unlike = (TAIL + f) / 2 * np.log1p(_squares(centred, precision) / TAIL)
    return Population(centred, precision, float(np.linalg.slogdet(covariance)[1]) / 2, unlike)


def fit_shapes(movie: Movie, links: Links | None, population: Population) -> Shapes:
    """Fit the change of shape along links; without links the shape tells nothing."""
    f = population.centred.shape[1]
    same = np.ones(movie.n_cells)
    unknown = Shapes(population, np.zeros(f), population.precision, 0.0, same, same)
    if links is None:
        return unknown
    source = np.flatnonzero((links.after >= 0) & (links.second < 0) & ~movie.cut)
    source = source[~movie.cut[links.after[source]]]
    source = source[:: max(1, len(source) // _FIT)]
    target = links.after[source]
    weight = links.confidence[target]
    if len(source) < 10 * f:
        return unknown
    a, b = population.centred[source], population.centred[target]
    w = weight[:, None]
    # Elongation is a vector: both components share one memory.
    top, bottom = np.sum(w * a * b, axis=0), np.sum(w * a * a, axis=0) + len(source) * _FLOOR**2
    top[1:3], bottom[1:3] = top[1:3].sum(), bottom[1:3].sum()
    memory = np.clip(top / bottom, 0.0, 1.0)
    rest = b - memory * a
    change = _robust_covariance(rest, weight) + _FLOOR**2 * np.eye(f)
    precision = np.asarray(np.linalg.inv(change), dtype=np.float64)
    constant = population.log_volume - float(np.linalg.slogdet(change)[1]) / 2
    square = _squares(rest, precision)
    # A cell that grows into the place of another may take any shape.
    bereft = _bereft(movie, links)
    beside = bereft[source]
    spread = np.where(bereft, _widening(square[beside], weight[beside], f), 1.0)
    odds = constant - f * np.log(spread[source]) + population.unlike[target]
    odds -= (TAIL + f) / 2 * np.log1p(square / spread[source] ** 2 / TAIL)
    informative = np.where(bereft, _informative(odds[beside], weight[beside]), 1.0)
    return Shapes(population, memory, precision, constant, spread, informative)


def _bereft(movie: Movie, links: Links) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Whether each cell (N,) vanishes before the next frame, or lies beside one that does."""
    gone = links.after < 0
    found: np.ndarray[tuple[int], np.dtype[np.bool_]] = gone | gone[movie.neighbours[:, :NEAR]].any(
        axis=1
    )
    return found


def _squares(values: FloatArray, precision: FloatArray) -> FloatArray:
    """Mahalanobis squares (L,) of values (L, F)."""
    found: FloatArray = np.sum((values @ precision) * values, axis=1)
    return found


def _widening(square: FloatArray, weight: FloatArray, f: int) -> float:
    """How many times wider (at least 1) the change of f descriptors is, from squares (L,)."""
    width = 1.0
    for _ in range(10):
        robust = weight * (TAIL + f) / (TAIL + square / width) * square / f
        width = (float(robust.sum()) + _PRIOR_BESIDE) / (float(weight.sum()) + _PRIOR_BESIDE)
    return float(np.sqrt(np.clip(width, 1.0, _WIDEST**2)))


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
    covariance = np.diag(np.average(values**2, axis=0, weights=weight) + 1e-9)
    for _ in range(6):
        square = _squares(values, np.asarray(np.linalg.inv(covariance), dtype=np.float64))
        w = weight * (TAIL + f) / (TAIL + square)
        covariance = (w[:, None] * values).T @ values / weight.sum() + 1e-9 * np.eye(f)
    return np.asarray(covariance, dtype=np.float64)

"""Divisions: one mother, two daughters, judged by place, distance and sizes."""

from dataclasses import dataclass

import numpy as np

from cellquant.track.costs import Links, Motion, Paths
from cellquant.track.kernels import division_gains
from cellquant.track.movie import LOG_AREA, FloatArray, IntArray, Movie

_PRIOR_DIVISIONS = 10.0
_PER_MOTHER = 3


@dataclass(frozen=True)
class Divisions:
    """Log-normal daughters: mean and deviation of each quantity.

    ``separation`` of the logarithm of the daughters' distance; ``total`` of the logarithm of
    their summed area over the mother's; ``uneven`` deviation of the logarithm of their ratio;
    ``mother`` of the logarithm of the mother's area; ``population`` of all cells' areas;
    ``width`` of the place of their middle.
    """

    separation: tuple[float, float]
    total: tuple[float, float]
    uneven: float
    mother: tuple[float, float]
    population: tuple[float, float]
    width: float


def fit_divisions(movie: Movie, links: Links | None, middle: FloatArray, width: float) -> Divisions:
    """Estimate the daughters' geometry from the divisions found, with a weak general prior."""
    area = movie.shape[:, LOG_AREA]
    centre = float(np.median(area))
    spread = max(1.4826 * float(np.median(np.abs(area - centre))), 0.1)
    population = (centre, spread)
    spacing = float(np.median(movie.spacing))
    mothers = np.empty(0, dtype=np.int64)
    if links is not None:
        mothers = np.flatnonzero(links.second >= 0)
    one, two = (
        (links.after[mothers], links.second[mothers]) if links is not None else (mothers, mothers)
    )
    apart = np.log(np.hypot(*(movie.position[one] - movie.position[two]).T))
    total = np.logaddexp(area[one], area[two]) - area[mothers]
    ratio = area[one] - area[two]
    place = (movie.position[one] + movie.position[two]) / 2 - middle[mothers]
    return Divisions(
        separation=_normal(apart, np.log(0.85 * spacing), 0.35, 0.1),
        total=_normal(total, 0.3, 0.35, 0.1),
        uneven=_normal(ratio, 0.0, 0.3, 0.1, fixed=True)[1],
        mother=_normal(area[mothers], centre, spread, 0.1),
        population=population,
        width=float(
            np.sqrt(
                (np.sum(place**2) / 2 + _PRIOR_DIVISIONS * (1.5 * width) ** 2)
                / (len(mothers) + _PRIOR_DIVISIONS)
            )
        ),
    )


def _normal(
    values: FloatArray, mean: float, deviation: float, floor: float, *, fixed: bool = False
) -> tuple[float, float]:
    n = len(values)
    centre = mean
    if not fixed:
        centre = (float(values.sum()) + _PRIOR_DIVISIONS * mean) / (n + _PRIOR_DIVISIONS)
    square = float(np.sum((values - centre) ** 2))
    variance = (square + _PRIOR_DIVISIONS * deviation**2) / (n + _PRIOR_DIVISIONS)
    return centre, max(float(np.sqrt(variance)), floor)


def propose(
    movie: Movie,
    index: int,
    candidates: IntArray,
    orphan: IntArray,
    middle: FloatArray,
    model: Divisions,
    tail: float,
    log_rate: float,
    leave: FloatArray,
    appear: FloatArray,
) -> tuple[IntArray, FloatArray]:
    """Divisions between frame `index` and the next that are likelier than three single cells.

    Returns (mother, daughter, daughter) as indices into all cells, at most three per mother, and
    their log odds.
    """
    first, last = int(movie.start[index]), int(movie.start[index + 1])
    limit = 12 * (last - first) + 64
    cells = np.empty((limit, 3), dtype=np.int64)
    gain = np.empty(limit)
    elapsed = float(movie.time[index + 1] - movie.time[index])
    found = division_gains(
        movie.position,
        movie.shape[:, LOG_AREA].copy(),
        candidates,
        orphan,
        middle,
        np.full(movie.n_cells, model.width * np.sqrt(elapsed)),
        tail,
        np.array(model.separation),
        np.array([*model.total, model.uneven]),
        np.array(model.population),
        np.array(model.mother),
        np.full(movie.n_cells, log_rate),
        leave,
        appear,
        first,
        last,
        cells,
        gain,
    )
    cells, gain = cells[:found], gain[:found]
    order = np.lexsort((-gain, cells[:, 0]))
    cells, gain = cells[order], gain[order]
    start = np.flatnonzero(np.r_[True, cells[1:, 0] != cells[:-1, 0]]) if found else order
    rank = np.arange(found) - np.repeat(start, np.diff(np.append(start, found)))
    keep = rank < _PER_MOTHER
    return cells[keep], gain[keep]


def predicted_middle(movie: Movie, paths: Paths, motion: Motion) -> FloatArray:
    """Where the middle of two daughters is expected, (N, 2), from what is known before."""
    frames = np.repeat(np.arange(len(movie.time)), np.diff(movie.start))
    elapsed = np.append(np.diff(movie.time), 1)[frames].astype(np.float64)
    step = paths.drift[frames] + (paths.around_after[:, 0] + paths.around_after[:, 1]) / 2
    return movie.position + step * elapsed[:, None]

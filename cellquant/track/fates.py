"""Births, deaths and divisions: how often, where, in which frames, and at which sizes."""

from dataclasses import dataclass

import numpy as np

from cellquant.track.movie import LOG_AREA, BoolArray, FloatArray, IntArray, Links, Movie

PLACES = 4  # inside the layer, near the edge of the view, cut by it, at the rim of the layer
INSIDE, EDGE, CUT, RIM = range(PLACES)
_PRIOR_EVENTS = 2.0
_PRIOR_RATE = 0.01
_FIRST_RATE = (0.02, 0.2, 0.2, 0.02)
_FIRST_DIVISIONS = 0.005
_UNBORN = 0.2
_MOST = 0.5
_EVEN_FRAMES = (30.0, 1e6)  # cells that a frame needs to have a rate of its own: least and most
_PRIOR_SIZES = 20.0
_SIZE_FLOOR = 0.05
_SIZE_LIMITS = (np.exp(-3.0), np.exp(3.0))


@dataclass(frozen=True)
class Rates:
    """Chance per cell and frame pair to vanish, to appear, to divide.

    ``vanish``, ``appear`` (P, 4) by frame and place; ``divide`` (P,). Entries of a frame belong
    to the step that leaves it, those of ``appear`` to the step that enters it.
    """

    vanish: FloatArray
    appear: FloatArray
    divide: FloatArray


@dataclass(frozen=True)
class Fates:
    """Log chance of every cell (N,) to stay, vanish and divide before the next frame, and to have
    appeared since the last, per area: ``appear`` where the size of cells that the edge cuts is not
    compared, ``appear_sized`` where it is."""

    stay: FloatArray
    vanish: FloatArray
    divide: FloatArray
    appear: FloatArray
    appear_sized: FloatArray


def places(movie: Movie, flow: FloatArray) -> tuple[IntArray, IntArray]:
    """Where every cell (N,) is when it may leave, and where it was when it may have come in."""
    frames = movie.frame_index
    reach = 0.75 * movie.spacing[frames]
    width, height = movie.field_of_view
    ahead = movie.position + flow
    back = movie.position.copy()
    drift = np.array([flow[movie.cells_of(i)].mean(axis=0) for i in range(len(movie.time))])
    back[movie.start[1] :] -= drift[frames[movie.start[1] :] - 1]

    def at_edge(point: FloatArray) -> BoolArray:
        x, y = point[:, 0], point[:, 1]
        margin = np.minimum.reduce([x, y, width - x, height - y])
        near: BoolArray = np.minimum(margin, movie.margin) < reach
        return near

    inside = np.where(movie.rim, RIM, INSIDE)

    def place(point: FloatArray) -> IntArray:
        found: IntArray = np.where(movie.cut, CUT, np.where(at_edge(point), EDGE, inside))
        return found

    return place(ahead), place(back)


def fit_rates(
    movie: Movie,
    links: Links | None,
    divided: FloatArray,
    born: FloatArray,
    leaving: IntArray,
    entering: IntArray,
) -> Rates:
    """Chances to vanish, appear and divide from counts, each with a weak prior.

    `divided` (N,) is the chance that each cell divides, and `born` (N,) that it is a daughter.

    Frames differ: the interval may be uneven, or many cells die at once. Every frame is drawn
    towards the mean over the movie, the more the better that mean explains all frames.
    """
    n_frames = len(movie.time)
    if links is None:
        first = np.tile(_FIRST_RATE, (n_frames, 1))
        return Rates(first, first, np.full(n_frames, _FIRST_DIVISIONS))
    frames = movie.frame_index

    def rate(event: FloatArray, among: BoolArray) -> FloatArray:
        events = np.bincount(frames[among], event[among], n_frames).astype(np.float64)
        cells = np.bincount(frames[among], minlength=n_frames).astype(np.float64)
        return _by_frame(events, cells)

    cell = np.arange(movie.n_cells)
    may_leave, may_enter = cell < movie.start[-2], cell >= movie.start[1]
    gone: FloatArray = np.where(links.after < 0, 1.0, 0.0)
    # If a division was none, one of the two daughters has appeared.
    daughter = (links.before >= 0) & (links.second[links.before] >= 0)
    new = np.where(links.before < 0, 1.0 - born, np.where(daughter, (1.0 - born) / 2, 0.0))
    vanish = [rate(gone, may_leave & (leaving == place)) for place in range(PLACES)]
    appear = [rate(new, may_enter & (entering == place)) for place in range(PLACES)]
    return Rates(np.column_stack(vanish), np.column_stack(appear), rate(divided, may_leave))


def _by_frame(events: FloatArray, cells: FloatArray) -> FloatArray:
    """Rate (P,) of each frame, from events and cells (P,) in it."""
    mean = (events.sum() + _PRIOR_EVENTS) / (cells.sum() + _PRIOR_EVENTS / _PRIOR_RATE)
    seen = cells > 0
    # Beta-binomial by moments: how much more do frames differ than chance allows?
    spread = np.sum((events - cells * mean)[seen] ** 2 / (cells[seen] * mean * (1.0 - mean)))
    excess = (spread - seen.sum()) / max(float(np.sum(cells[seen] - 1.0)), 1.0)
    least, most = _EVEN_FRAMES
    prior = np.clip(1.0 / max(float(excess), 1e-9), least, most)
    rate: FloatArray = np.minimum((events + prior * mean) / (cells + prior), _MOST)
    return rate


def suppose_divisions(rates: Rates) -> Rates:
    """Rates for the first look for divisions: what appeared inside was mostly born there."""
    born = np.append(rates.appear[1:, INSIDE], rates.appear[-1:, INSIDE])
    born = np.maximum(born, rates.divide)
    appear = rates.appear.copy()
    appear[:, INSIDE] *= _UNBORN
    return Rates(rates.vanish, appear, born)


def fates(
    movie: Movie, links: Links | None, rates: Rates, leaving: IntArray, entering: IntArray
) -> Fates:
    """Chances of each cell from the rates, and from the size of vanishing and dividing cells.

    The logarithm of the area is normal among the cells of each fate, with a prior that makes them
    look like any cell.
    """
    frames = movie.frame_index
    vanish = rates.vanish[frames, leaving]
    appear = rates.appear[frames, entering]
    divide = rates.divide[frames]
    stay = np.maximum(1.0 - vanish - divide, 0.1)
    sized = appear.copy()
    if links is not None:
        size = movie.shape[:, LOG_AREA]
        cell, last, first = np.arange(movie.n_cells), movie.start[-2], movie.start[1]
        gone = (cell < last) & (links.after < 0)
        split = (cell < last) & (links.second >= 0)
        new = (cell >= first) & (links.before < 0)
        # What is seen of cells that the edge cuts is compared among them, and tells of newcomers
        # alone: links of such cells do not compare sizes.
        for kind in (movie.cut, ~movie.cut):
            if not kind.any():
                continue
            usual = _size_law(size[(cell < last) & kind & ~gone & ~split], None)
            sized[kind] *= _size_ratio(size[kind], size[new & kind], usual)
            if kind is not movie.cut:
                vanish[kind] *= _size_ratio(size[kind], size[gone & kind], usual)
                divide[kind] *= _size_ratio(size[kind], size[split & kind], usual)
        total = stay + vanish + divide
        stay, vanish, divide = stay / total, vanish / total, divide / total
        sized = np.minimum(sized, _MOST)
        appear = np.where(movie.cut, appear, sized)
    return Fates(
        np.log(np.maximum(stay, 1e-6)),
        np.log(np.maximum(vanish, 1e-9)),
        np.log(np.maximum(divide, 1e-12)),
        np.log(appear * movie.density),
        np.log(sized * movie.density),
    )


def _size_law(values: FloatArray, prior: tuple[float, float] | None) -> tuple[float, float]:
    """Mean and width of sizes, drawn towards the prior; robust where there is none."""
    if prior is None:
        mean = float(np.median(values)) if len(values) else 0.0
        width = 1.4826 * float(np.median(np.abs(values - mean))) if len(values) else 1.0
        return mean, max(width, _SIZE_FLOOR)
    n = len(values) + _PRIOR_SIZES
    mean = (float(values.sum()) + _PRIOR_SIZES * prior[0]) / n
    square = float(np.sum((values - mean) ** 2))
    square += _PRIOR_SIZES * (prior[1] ** 2 + (prior[0] - mean) ** 2)
    return mean, max(float(np.sqrt(square / n)), _SIZE_FLOOR)


def _size_ratio(size: FloatArray, among: FloatArray, usual: tuple[float, float]) -> FloatArray:
    """How much likelier each size (N,) is among some cells than usual, within a factor of 20."""
    mean, width = _size_law(among, usual)
    # The cube of the ratio of both terms is the ratio of two Student densities.
    near, far = (size - mean) / width, (size - usual[0]) / usual[1]
    ratio: FloatArray = (5.0 + far**2) / (5.0 + near**2)
    return np.clip(ratio**3 * (usual[1] / width), *_SIZE_LIMITS)

"""Collective motion between two frames, found before any cell is linked."""

import numpy as np
from scipy.ndimage import gaussian_filter

from cellquant.track.motion_kernels import soft_flow
from cellquant.track.movie import FloatArray, Movie
from cellquant.track.near import nearest_cells

CANDIDATES = 10  # nearest cells around the predicted place that are considered at all
_WIDTHS = (0.6, 0.2)  # of the soft assignment, first and last, in units of the spacing
_STEPS = 8
_OUTLIER = 0.1
_VOTERS = 2000
_ENOUGH_MATCHED = 0.75
_FLOW_CANDIDATES = 8
_SAME, _SAME_SHARE = 0.1, 0.9  # fields that differ by less, in spacings, in this share of the cells
_FORETOLD_WIDTHS = np.geomspace(0.05, 2.0, 14)  # of the spacing
_STRAY = 0.1  # chance that a cell follows no field
_CHANCE = 2.0  # standard errors by which a field must be better than a simpler one


def common_shift(here: FloatArray, there: FloatArray, spacing: float) -> FloatArray:
    """Most frequent displacement between the cells of two frames, (2,).

    Displacements of all pairs up to two spacings apart are counted on a grid of a fifth of the
    spacing; true displacements pile up while wrong pairs spread evenly.
    """
    if len(here) > _VOTERS:
        here = here[:: -(-len(here) // _VOTERS)]
    reach = 2.0 * spacing
    nearest, square = nearest_cells(here, there, 16)
    row, column = np.nonzero(square < reach**2)
    if row.size == 0:
        return np.zeros(2)
    step = there[nearest[row, column]] - here[row]
    edges = np.linspace(-reach, reach, 22)
    votes, _, _ = np.histogram2d(step[:, 0], step[:, 1], [edges, edges])
    smooth = gaussian_filter(votes, 1.0, mode="constant")
    best = np.unravel_index(int(np.argmax(smooth)), smooth.shape)
    centre = (edges[:-1] + edges[1:]) / 2
    shift = np.array([centre[best[0]], centre[best[1]]])
    close = np.hypot(*(step - shift).T) < 0.3 * spacing
    return step[close].mean(axis=0) if close.any() else shift


def pair_flow(movie: Movie, index: int, previous: FloatArray) -> FloatArray:
    """Displacement (n, 2) that the neighbourhood of each cell makes to the next frame.

    Starts from rest and from the motion before. Where both lead to the same field and most cells
    find a partner in it, that is the flow. Elsewhere the most frequent displacement is a third
    start, and fields are compared by the cells that had no part in them: one is taken in place of
    a simpler one if it foretells the next frame better by more than chance. A layer where nothing
    can be told apart is so taken to rest, not to move as its nearest cells happen to lie.

    Parameters
    ----------
    movie
        The movie.
    index
        Index of the first of the two frames.
    previous
        (n, 2) displacement expected from the frames before.
    """
    a, b = movie.cells_of(index), movie.cells_of(index + 1)
    here, there = movie.position[a], movie.position[b]
    spacing = min(movie.spacing[index], movie.spacing[index + 1])
    neighbours = movie.neighbours[a, :8] - movie.start[index]
    widths = spacing * np.geomspace(*_WIDTHS, _STEPS)
    rounds = np.maximum(1, np.linspace(3, 0, _STEPS).round()).astype(np.int64)
    all_cells = np.ones(len(here))

    def follow(start: FloatArray, voice: FloatArray) -> tuple[FloatArray, float]:
        candidates, _ = nearest_cells(here + start, there, min(_FLOW_CANDIDATES, len(there)))
        flow = start.copy()
        matched = soft_flow(
            here, there, candidates, neighbours, flow, widths, rounds, _OUTLIER, voice
        )
        return flow, matched

    rest = np.zeros((len(here), 2))
    flow, matched = follow(rest, all_cells)
    if np.abs(previous).max(initial=0.0) > _SAME * spacing:
        other, other_matched = follow(previous, all_cells)
        away = np.hypot(*(flow - other).T)
        same = float(np.mean(away < _SAME * spacing)) >= _SAME_SHARE
        flow, matched = other, min(matched, other_matched)
    else:
        same = True
    if same and matched >= _ENOUGH_MATCHED:
        return flow

    def foretold(start: FloatArray, *, refined: bool) -> FloatArray:
        value = np.zeros(len(here))
        for half in (0.0, 1.0):
            voice = (np.arange(len(here)) % 2 == half) * 1.0
            field = follow(start, voice)[0] if refined else start
            silent = voice == 0.0
            if not silent.any():
                continue
            _, square = nearest_cells(here[silent] + field[silent], there, CANDIDATES)
            value[silent] = _foretold(square, movie.density[a][silent], spacing)
        return value

    shift = np.tile(common_shift(here, there, spacing), (len(here), 1))
    best, start, refine = foretold(rest, refined=False), rest, False
    for other_start, refined in ((rest, True), (previous, True), (shift, False), (shift, True)):
        value = foretold(other_start, refined=refined)
        gain = value - best
        if gain.mean() > _CHANCE * gain.std() / np.sqrt(len(gain)):
            best, start, refine = value, other_start, refined
    return follow(start, all_cells)[0] if refine else start


def _foretold(square: FloatArray, density: FloatArray, spacing: float) -> FloatArray:
    """Log odds (n,) that one of the candidates of each cell follows its field, at the width that
    suits all best.

    square (n, K) are the squared distances of the candidates from where the field leads; density
    (n,) is that of the cells, which lie anywhere otherwise.
    """
    best = np.full(len(square), -np.inf)
    for width in (_FORETOLD_WIDTHS * spacing).tolist():
        near = (1.0 + square / (4.0 * width**2)) ** -3 / (2.0 * np.pi * width**2)
        odds = np.log(_STRAY + (1.0 - _STRAY) * near.sum(axis=1) / density)
        if odds.mean() > best.mean():
            best = odds
    return best


def all_flows(movie: Movie, *, local: bool = True) -> tuple[FloatArray, FloatArray]:
    """Displacement (N, 2) of the neighbourhood of each cell to the next frame; 0 in the last.

    The second array (N, 2) is the flow per frame of the frame before, at the cells that it brings
    nearest; 0 in the first. Without `local`, all cells of a frame share the most frequent
    displacement.
    """
    flow, carried = np.zeros((movie.n_cells, 2)), np.zeros((movie.n_cells, 2))
    for index in range(len(movie.time) - 1):
        a, b = movie.cells_of(index), movie.cells_of(index + 1)
        here, there = movie.position[a], movie.position[b]
        elapsed = float(movie.time[index + 1] - movie.time[index])
        if local:
            flow[a] = pair_flow(movie, index, carried[a] * elapsed)
        else:
            flow[a] = common_shift(here, there, min(movie.spacing[index], movie.spacing[index + 1]))
        origin, _ = nearest_cells(there, here + flow[a], 1)
        carried[b] = flow[a][origin[:, 0]] / elapsed
    return flow, carried

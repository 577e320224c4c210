"""Collective motion between two frames, found before any cell is linked."""

import numpy as np
from scipy.ndimage import gaussian_filter

from cellquant.track.kernels import soft_flow
from cellquant.track.movie import FloatArray, Movie
from cellquant.track.near import nearest_cells

CANDIDATES = 10  # nearest cells around the predicted place that are considered at all
_WIDTHS = (0.6, 0.2)  # of the soft assignment, first and last, in units of the spacing
_STEPS = 8
_OUTLIER = 0.1
_VOTERS = 2000
_ENOUGH_MATCHED = 0.75
_FLOW_CANDIDATES = 8


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


def pair_flow(movie: Movie, index: int, previous: FloatArray | None) -> FloatArray:
    """Displacement (n, 2) that the neighbourhood of each cell makes to the next frame.

    Parameters
    ----------
    movie
        The movie.
    index
        Index of the first of the two frames.
    previous
        (n, 2) displacement expected from the frames before; None where there are none.

    Starts from `previous`, and also from the most frequent displacement where that start leaves
    many cells without a partner; keeps the start that finds more.
    """
    a, b = movie.cells_of(index), movie.cells_of(index + 1)
    here, there = movie.position[a], movie.position[b]
    spacing = min(movie.spacing[index], movie.spacing[index + 1])
    neighbours = movie.neighbours[a, :8] - movie.start[index]
    widths = spacing * np.geomspace(*_WIDTHS, _STEPS)
    rounds = np.maximum(1, np.linspace(3, 0, _STEPS).round()).astype(np.int64)

    def follow(start: FloatArray) -> tuple[FloatArray, float]:
        candidates, _ = nearest_cells(here + start, there, min(_FLOW_CANDIDATES, len(there)))
        flow = start.copy()
        matched = soft_flow(here, there, candidates, neighbours, flow, widths, rounds, _OUTLIER)
        return flow, matched

    flow, matched = (np.zeros((0, 2)), -1.0) if previous is None else follow(previous)
    if matched < _ENOUGH_MATCHED:
        shift = common_shift(here, there, spacing)
        other, other_matched = follow(np.tile(shift, (len(here), 1)))
        if other_matched > matched + 1e-9:
            flow = other
    return flow


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
            flow[a] = pair_flow(movie, index, carried[a] * elapsed if index > 0 else None)
        else:
            flow[a] = common_shift(here, there, min(movie.spacing[index], movie.spacing[index + 1]))
        origin, _ = nearest_cells(there, here + flow[a], 1)
        carried[b] = flow[a][origin[:, 0]] / elapsed
    return flow, carried

"""Collective motion between two frames, found before any cell is linked."""

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree

from cellquant.track.kernels import soft_flow
from cellquant.track.movie import FloatArray, IntArray, Movie

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
    k = min(16, len(there))
    distance, nearest = cKDTree(there).query(here, k, distance_upper_bound=reach)
    distance, nearest = distance.reshape(len(here), k), nearest.reshape(len(here), k)
    row, column = np.nonzero(np.isfinite(distance))
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


def nearest_cells(points: FloatArray, there: FloatArray, k: int = CANDIDATES) -> IntArray:
    """Indices (n, k) of the cells nearest to each point; -1 where there are not so many."""
    k_there = min(k, len(there))
    found = np.full((len(points), k), -1, dtype=np.int64)
    _, nearest = cKDTree(there).query(points, k_there)
    found[:, :k_there] = nearest.reshape(len(points), k_there)
    return found


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
        candidates = nearest_cells(here + start, there, min(_FLOW_CANDIDATES, len(there)))
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


def all_flows(movie: Movie, *, local: bool = True) -> FloatArray:
    """Displacement (N, 2) of the neighbourhood of each cell to the next frame; 0 in the last.

    Without `local`, all cells of a frame share the most frequent displacement.
    """
    flow = np.zeros((movie.n_cells, 2))
    previous: FloatArray | None = None
    for index in range(len(movie.time) - 1):
        a, b = movie.cells_of(index), movie.cells_of(index + 1)
        if not local:
            spacing = min(movie.spacing[index], movie.spacing[index + 1])
            flow[a] = common_shift(movie.position[a], movie.position[b], spacing)
            continue
        flow[a] = pair_flow(movie, index, previous)
        if index + 2 < len(movie.time):
            arrived = movie.position[a] + flow[a]
            _, nearest = cKDTree(arrived).query(movie.position[b])
            elapsed = movie.time[index + 1] - movie.time[index]
            ahead = movie.time[index + 2] - movie.time[index + 1]
            previous = flow[a][nearest] * (ahead / elapsed)
    return flow

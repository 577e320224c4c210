"""The plain baseline: trackpy's nearest-neighbour linking of centroids."""

import warnings
from typing import Any

import numpy as np
import pandas as pd

from cellquant.track.movie import IntArray, Movie


def trackpy_links(
    movie: Movie, *, max_distance: float | None, max_gap: int
) -> tuple[IntArray, dict[str, Any]]:
    """Link by trackpy; the search range is half the typical spacing when none is given.

    trackpy refuses to solve subnets of more than 30 cells; the range then shrinks by its own
    adaptive steps, to a tenth at the least.
    """
    import trackpy

    trackpy.quiet()
    reach = max_distance if max_distance is not None else 0.5 * float(np.median(movie.spacing))
    table = pd.DataFrame(
        {"x": movie.position[:, 0], "y": movie.position[:, 1], "frame": movie.frame}
    )
    table["cell"] = np.arange(movie.n_cells)
    with warnings.catch_warnings():
        # trackpy's use of pandas is not for our users to mend.
        warnings.simplefilter("ignore", DeprecationWarning)
        warnings.simplefilter("ignore", FutureWarning)
        linked = trackpy.link(
            table, reach, memory=max_gap, adaptive_stop=0.1 * reach, adaptive_step=0.9
        )
    linked = linked.sort_values(["particle", "frame", "cell"], kind="stable")
    cell, particle = linked["cell"].to_numpy(np.int64), linked["particle"].to_numpy()
    after = np.full(movie.n_cells, -1, dtype=np.int64)
    same = particle[1:] == particle[:-1]
    after[cell[:-1][same]] = cell[1:][same]
    joined = np.flatnonzero(after >= 0)
    gaps = int(np.sum(movie.frame[after[joined]] - movie.frame[joined] > 1))
    return after, {
        "search_range": float(reach),
        "search_range_reason": "given" if max_distance is not None else "half the typical spacing",
        "divisions": 0,
        "gaps_closed": gaps,
        "warnings": [],
    }

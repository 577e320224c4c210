"""Standard errors from replicate blocks: who is grouped, and what the groups' spread means.

Cells that neighbour each other move together and a cell resembles itself a frame later, so
neither is a replicate. Tracks are gathered into compact groups of near-equal size, and the
spread of the result over the groups gives its error.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from cellquant.observables.trajectories import FloatArray


@dataclass(frozen=True)
class Blocks:
    """Assignment of items (tracks or cells) to replicate blocks.

    Attributes
    ----------
    index
        (n_items,) block of each item.
    n
        Number of blocks.
    method
        How the blocks were made, in words, for ``std_error_method``.
    """

    index: Any
    n: int
    method: str


def spatial_blocks(centre: FloatArray, *, box: tuple[float, float] | None = None) -> Blocks:
    """Group items into compact blocks of near-equal number.

    The items are cut into k strips along x by rank, and each strip into k pieces along y, with
    k = 5 from 400 items and k = 4 from 64. Fewer than 64 items are one block each.

    Parameters
    ----------
    centre
        (n, 2) positions, wrapped into the box when there is one.
    box
        Edges of the periodic box.

    Returns
    -------
    Blocks
    """
    n = centre.shape[0]
    if n < 64:
        return Blocks(np.arange(n), n, f"jackknife over {n} tracks")
    k = 5 if n >= 400 else 4
    place = np.mod(centre, box) if box is not None else centre
    order_x = np.argsort(place[:, 0], kind="stable")
    strip = np.empty(n, dtype=np.int64)
    strip[order_x] = np.arange(n) * k // n
    index = np.empty(n, dtype=np.int64)
    for s in range(k):
        members = np.flatnonzero(strip == s)
        rank = np.empty(members.size, dtype=np.int64)
        rank[np.argsort(place[members, 1], kind="stable")] = np.arange(members.size)
        index[members] = s * k + rank * k // members.size
    return Blocks(index, k * k, f"jackknife over {k * k} spatial blocks of tracks")


def sum_by_block(values: FloatArray, blocks: Blocks) -> FloatArray:
    """Sum rows (items, ...) into (n_blocks, ...), in the order of the rows."""
    out = np.zeros((blocks.n, *values.shape[1:]))
    np.add.at(out, blocks.index, values)
    return out


def leave_one_out(sums: FloatArray) -> FloatArray:
    """Totals without each block in turn, (n_blocks, ...)."""
    left: FloatArray = sums.sum(axis=0)[None] - sums
    return left


def jackknife_error(replicates: FloatArray, informative: FloatArray | None = None) -> FloatArray:
    """Standard error from leave-one-block-out results.

    ``SE^2 = (B - 1)/B sum_b (theta_(-b) - mean theta_(-))^2`` over the B blocks that carry data.

    Parameters
    ----------
    replicates
        (n_blocks, ...) results without each block.
    informative
        (n_blocks, ...) number of data in each block; blocks with none are left out. All carry
        data when None.

    Returns
    -------
    numpy.ndarray
        (...) standard errors, NaN with fewer than two blocks, or where a replicate is undefined.

    References
    ----------
    Efron & Tibshirani, An Introduction to the Bootstrap (1993), chapter 11.
    """
    used = np.ones(replicates.shape, dtype=bool)
    if informative is not None:
        used &= informative > 0
    n = used.sum(axis=0)
    defined = ~used | np.isfinite(replicates)
    values = np.where(used & defined, replicates, 0.0)
    mean = values.sum(axis=0) / np.maximum(n, 1)
    squares = np.where(used & defined, (values - mean) ** 2, 0.0).sum(axis=0)
    error = np.sqrt((n - 1) / np.maximum(n, 1) * squares)
    return np.where((n >= 2) & defined.all(axis=0), error, np.nan)


def ratio_with_error(sums: FloatArray, counts: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Ratio of totals and its jackknife error.

    Parameters
    ----------
    sums, counts
        (n_blocks, ...) numerators and denominators per block.

    Returns
    -------
    value, std_error : numpy.ndarray
        (...) NaN where the total count is zero.
    """
    total = counts.sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        value = np.where(total > 0, sums.sum(axis=0) / total, np.nan)
        replicates = leave_one_out(sums) / leave_one_out(counts)
    return value, jackknife_error(replicates, counts)

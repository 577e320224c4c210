"""Who neighbours whom: hexatic bond order and numbers of neighbours."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from scipy.spatial import Delaunay, QhullError

from cellquant.observables.blocks import (
    Blocks,
    jackknife_error,
    ratio_with_error,
    sum_by_block,
)
from cellquant.observables.layer import Layer, blocks_of, layer_of, positions_by_frame
from cellquant.observables.trajectories import FloatArray, IntArray
from cellquant.rows import Scan
from cellquant.tables import Cells, Tracks


def neighbour_pairs(
    place: FloatArray, edges: FloatArray | None = None
) -> tuple[IntArray, FloatArray, Any]:
    """Pairs of Delaunay neighbours.

    Parameters
    ----------
    place
        (n, 2) positions, inside the box when there is one.
    edges
        (2,) edges of a periodic box, or None.

    Returns
    -------
    pairs : numpy.ndarray
        (m, 2) ordered pairs: each bond occurs in both directions.
    bonds : numpy.ndarray
        (m, 2) vectors from the first to the second.
    inside : numpy.ndarray
        (n,) whether a cell is not on the convex hull; all True in a periodic box.
    """
    n = len(place)
    nothing = np.empty((0, 2), dtype=np.int64), np.empty((0, 2)), np.zeros(n, dtype=bool)
    if n < 4 and edges is None:
        return nothing
    points, origin = place, np.arange(n)
    if edges is not None:
        # Images out to four mean spacings (or a whole box) hold every neighbour of the originals.
        margin = np.minimum(4 * np.sqrt(np.prod(edges) / n) + 0 * edges, edges)
        copies, names = [place], [origin]
        for i in (-1, 0, 1):
            for j in (-1, 0, 1):
                if i == j == 0:
                    continue
                moved = place + np.array([i, j]) * edges
                near = ((moved > -margin) & (moved < edges + margin)).all(axis=1)
                copies.append(moved[near])
                names.append(origin[near])
        points, origin = np.vstack(copies), np.concatenate(names)
    try:
        mesh = Delaunay(points)
    except QhullError:
        return nothing
    starts, targets = mesh.vertex_neighbor_vertices
    first = np.repeat(np.arange(len(points)), np.diff(starts))
    own = first < n
    first, second = first[own], targets[own].astype(np.int64)
    inside = np.ones(n, dtype=bool)
    if edges is None:
        inside[np.unique(mesh.convex_hull)] = False
    return np.column_stack([first, origin[second]]), points[second] - points[first], inside


@dataclass(frozen=True)
class BondOrder:
    """Hexatic order and neighbour numbers.

    Attributes
    ----------
    hexatic
        Per frame: frame, value (|<psi_6>|), local (<|psi_6|>), n.
    summary
        mean local order, mean global order, with errors.
    neighbours
        Distribution: n_neighbours, value (fraction), std_error, n.
    neighbour_summary
        mean and std of the number of neighbours.
    """

    hexatic: pd.DataFrame
    summary: dict[str, Any]
    neighbours: pd.DataFrame
    neighbour_summary: dict[str, Any]


def bond_order(source: Tracks | Cells | Scan | Layer, *, max_frames: int = 32) -> BondOrder:
    """Hexatic bond order and number of Delaunay neighbours.

    ``psi_6(j) = z_j^-1 sum_k exp(6 i theta_jk)`` over the z_j Delaunay neighbours k of cell j;
    the global order of a frame is ``|<psi_6>|``. Cells that touch the border of the image or lie
    on the convex hull have neighbours but are not counted.

    Parameters
    ----------
    source
        Tracks, cells, or a layer.
    max_frames
        Frames used, evenly spaced.

    Returns
    -------
    BondOrder
        Undefined where no cell has all its neighbours in view. The global order of n independent
        cells is about ``sqrt(pi/4 <|psi_6|^2>/n)``, not zero.

    References
    ----------
    Nelson & Halperin, Phys. Rev. B 19, 2457 (1979), doi:10.1103/PhysRevB.19.2457.
    """
    layer = layer_of(source, max_frames=max_frames)
    psi = np.zeros(len(layer.rows), dtype=np.complex128)
    number = np.zeros(len(layer.rows), dtype=np.int64)
    counted = np.zeros(len(layer.rows), dtype=bool)
    border = layer.rows["touches_border"].to_numpy(dtype=bool)
    records = []
    for frame, (rows, place) in zip(layer.frames, positions_by_frame(layer), strict=True):
        pairs, bonds, inside = neighbour_pairs(place, layer.edges if layer.periodic else None)
        z = np.bincount(pairs[:, 0], minlength=len(rows))
        turn = np.exp(6j * np.arctan2(bonds[:, 1], bonds[:, 0]))
        total = np.bincount(pairs[:, 0], weights=turn.real, minlength=len(rows)) + 1j * np.bincount(
            pairs[:, 0], weights=turn.imag, minlength=len(rows)
        )
        ok = inside & ~border[rows] & (z > 0)
        psi[rows], number[rows], counted[rows] = total / np.maximum(z, 1), z, ok
        if ok.any():
            local = psi[rows[ok]]
            records.append((frame, abs(local.mean()), np.abs(local).mean(), int(ok.sum())))
    hexatic = pd.DataFrame(records, columns=["frame", "value", "local", "n"])
    hexatic = hexatic.astype(
        {"frame": "int64", "value": "float64", "local": "float64", "n": "int64"}
    )
    if not records:
        reason = "no cell has all its neighbours in view"
        empty = pd.DataFrame({"n_neighbours": [], "value": [], "std_error": [], "n": []})
        none = {"mean": None, "std_error": None, "reason": reason}
        empty = empty.astype({"n_neighbours": "int64", "n": "int64"})
        return BondOrder(hexatic, {**none, "global": None}, empty, {**none, "std": None})
    used = layer.rows[counted]
    blocks = blocks_of(layer, counted)
    summary = _mean(np.abs(psi[counted]), blocks)
    # The global order of each frame without each block in turn, averaged over frames.
    frame = np.searchsorted(layer.frames, used["frame"].to_numpy())
    total = np.zeros((blocks.n, layer.frames.size), dtype=np.complex128)
    size = np.zeros((blocks.n, layer.frames.size))
    np.add.at(total, (blocks.index, frame), psi[counted])
    np.add.at(size, (blocks.index, frame), 1.0)
    rest = np.maximum(size.sum(axis=0) - size, 1)
    without = np.abs((total.sum(axis=0) - total) / rest).mean(axis=1)
    summary["global"] = float(hexatic["value"].mean())
    summary["global_std_error"] = float(jackknife_error(without))
    z = number[counted]
    return BondOrder(hexatic, summary, _fractions(z, blocks), {
        **_mean(z.astype(np.float64), blocks), "std": float(z.std(ddof=1)) if z.size > 1 else None,
        "rule": "Delaunay neighbours of cells away from the border",
    })  # fmt: skip


def _mean(values: FloatArray, blocks: Blocks) -> dict[str, Any]:
    sums, counts = sum_by_block(values, blocks), sum_by_block(np.ones_like(values), blocks)
    mean, error = ratio_with_error(sums, counts)
    return {
        "mean": float(mean),
        "std_error": float(error),
        "n": int(values.size),
        "std_error_method": blocks.method,
    }


def _fractions(z: IntArray, blocks: Blocks) -> pd.DataFrame:
    kinds = np.arange(z.min(), z.max() + 1)
    hits = sum_by_block((z[:, None] == kinds).astype(np.float64), blocks)
    size = np.repeat(sum_by_block(np.ones(z.size), blocks)[:, None], kinds.size, axis=1)
    value, error = ratio_with_error(hits, size)
    return pd.DataFrame(
        {
            "n_neighbours": kinds,
            "value": value,
            "std_error": error,
            "n": hits.sum(axis=0).astype(np.int64),
        }
    )

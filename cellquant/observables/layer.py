"""Positions of a few frames of a layer, and the region that its cells can occupy."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd

from cellquant.observables.blocks import Blocks
from cellquant.observables.region import REGION_RULE, Region, find_region
from cellquant.observables.shape import cell_blocks
from cellquant.observables.trajectories import FloatArray, IntArray
from cellquant.rows import Scan, rows_of
from cellquant.tables import TRACK_COLUMNS, Cells, Tracks


@dataclass(frozen=True)
class Layer:
    """Positions of some frames, and the rectangle they live in.

    Attributes
    ----------
    rows
        Rows of the source in the chosen frames with a finite position.
    frames
        The chosen frame numbers.
    corner, edges
        Lower corner and edges of the rectangle: the periodic box, or the extent of all positions.
    periodic
        Whether the rectangle is a periodic box.
    """

    rows: pd.DataFrame
    frames: IntArray
    corner: FloatArray
    edges: FloatArray
    periodic: bool

    @cached_property
    def regions(self) -> list[Region | None]:
        """Of each frame the part of the rectangle that cells can occupy; None where it is all."""
        if self.periodic or not (self.edges > 0).all():
            return [None] * self.frames.size
        return [find_region(place, self.edges) for _, place in positions_by_frame(self)]

    @property
    def filled(self) -> float:
        """Share of the rectangle that cells can occupy, mean over the frames."""
        shares = [1.0 if region is None else region.share for region in self.regions]
        return float(np.mean(shares)) if shares else 1.0

    @property
    def note(self) -> dict[str, Any]:
        """Summary entries on a rectangle that cells fill in part only; nothing where they do."""
        if self.filled > 0.9:
            return {}
        note = (
            f"cells can occupy {self.filled:.0%} of the rectangle around them ({REGION_RULE}): "
            "g(r) is normalised by that part, S(q) at small q shows its outline"
        )
        return {"filled": self.filled, "note": note}


def layer_of(source: Tracks | Cells | Scan | Layer, *, max_frames: int = 32) -> Layer:
    """Choose at most max_frames frames, evenly spaced, and the rectangle around the cells.

    Of a table on disk only these frames are held. A layer is returned as it is.
    """
    if isinstance(source, Layer):
        return source
    head = source.head if isinstance(source, Scan) else source
    rows = rows_of(source)
    present = np.empty(0, dtype=np.int64)
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for piece in rows.pieces("frame", "x", "y"):
        x, y = piece["x"], piece["y"]
        known = np.isfinite(x) & np.isfinite(y)
        present = np.union1d(present, piece["frame"][known])
        if known.any():
            low = np.minimum(low, (x[known].min(), y[known].min()))
            high = np.maximum(high, (x[known].max(), y[known].max()))
    if present.size > max_frames:
        chosen = np.round(np.linspace(0, present.size - 1, max_frames)).astype(np.int64)
        present = present[chosen]
    box = head.box if isinstance(head, Tracks) else None
    corner, edges = np.zeros(2), np.zeros(2)
    if box is not None:
        edges = np.array(box, dtype=np.float64)
    elif present.size:
        corner, edges = low, high - low
    names = ("frame", "x", "y", "touches_border", *(("track_id",) if rows.linked else ()))
    parts = []
    for piece in rows.pieces(*names):
        used = np.isin(piece["frame"], present)
        used &= np.isfinite(piece["x"]) & np.isfinite(piece["y"])
        parts.append(pd.DataFrame({name: piece[name][used] for name in names}))
    empty = pd.DataFrame({name: np.empty(0, TRACK_COLUMNS[name]) for name in names})
    table = pd.concat(parts, ignore_index=True) if parts else empty
    table = table.sort_values("frame", kind="stable").reset_index(drop=True)
    return Layer(table, present, corner, edges, box is not None)


def blocks_of(layer: Layer, used: Any = slice(None)) -> Blocks:
    """Replicate blocks of the rows of a layer, or of some of them."""
    rows = layer.rows[used]
    track = rows["track_id"].to_numpy() if "track_id" in rows.columns else None
    box = (float(layer.edges[0]), float(layer.edges[1])) if layer.periodic else None
    return cell_blocks(rows[["x", "y"]].to_numpy(dtype=np.float64), track, box)


def positions_by_frame(layer: Layer) -> list[tuple[IntArray, FloatArray]]:
    """Row numbers and positions of each frame, inside the rectangle."""
    frame = layer.rows["frame"].to_numpy(dtype=np.int64)
    place = layer.rows[["x", "y"]].to_numpy(dtype=np.float64) - layer.corner
    if layer.periodic:
        place = np.mod(place, layer.edges)
        place = np.where(place >= layer.edges, 0.0, place)
    cuts = np.searchsorted(frame, layer.frames)
    groups = np.split(np.arange(frame.size), cuts[1:]) if frame.size else []
    return [(rows, place[rows]) for rows in groups]

"""A run as a movie: label masks, true tracks and contours, and a picture like phase contrast."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import tifffile
from numba import njit
from numpy.typing import NDArray

from cellquant.errors import InputError
from cellquant.io import LabelStack, read_labels, write_ctc, write_labels
from cellquant.sim.archive import Run
from cellquant.sim.shapes import contours, mean_radii, measure_shapes
from cellquant.storage import atomic_path
from cellquant.tables import PHYSICAL, TRACK_COLUMNS, Tracks

Floats = NDArray[np.float64]
Labels = NDArray[np.int32]
HALO = 1.35  # how far the halo of a cell reaches, in units of its radius in that direction
SMALLEST_PART = 8  # pixels; smaller parts at the border are not drawn
CONTOUR_POINTS = 64


@dataclass(frozen=True)
class Rendering:
    """What `render` wrote.

    Attributes
    ----------
    masks, truth, phase_contrast
        The label masks; the folder with the true tracks as a CTC folder, ``tracks.parquet`` and
        ``contours.npy``; the picture, None where not asked for.
    tracks
        The true tracks, in um and min; (frame, label) finds the cell in the masks.
    shape
        Height and width of the field in pixels.
    """

    masks: Path
    truth: Path
    phase_contrast: Path | None
    tracks: Tracks
    shape: tuple[int, int]


@njit(cache=True, error_model="numpy")
def draw(
    position: Any, theta: Any, radius: Any, mean: Any, modes: Any, pixel: float, texture: Any,
    out: Any, nearest: Any, shade: Any,
) -> None:  # fmt: skip
    """Draw cells (already shifted into the field) into `out` as index plus one.

    A pixel belongs to the cell of the smallest r / R(phi), if that is below one. `nearest` keeps
    that ratio up to HALO, `shade` a pattern that moves with the cell.
    """
    height, width = out.shape
    n_modes = modes.shape[2]
    re = np.empty(n_modes)
    im = np.empty(n_modes)
    for i in range(position.shape[0]):
        largest = 0.0
        for m in range(n_modes):
            a = modes[i, 0, m]
            b = modes[i, 1, m]
            largest += math.sqrt(a * a + b * b)
            angle = (m + 2) * theta[i]
            re[m] = a * math.cos(angle) - b * math.sin(angle)
            im[m] = -b * math.cos(angle) - a * math.sin(angle)
        reach = HALO * radius[i] * (abs(mean[i]) + largest)
        x0 = position[i, 0]
        y0 = position[i, 1]
        top = max(0, math.ceil((y0 - reach) / pixel))
        bottom = min(height, math.floor((y0 + reach) / pixel) + 1)
        left = max(0, math.ceil((x0 - reach) / pixel))
        right = min(width, math.floor((x0 + reach) / pixel) + 1)
        for row in range(top, bottom):
            for column in range(left, right):
                x = column * pixel - x0
                y = row * pixel - y0
                r = math.sqrt(x * x + y * y)
                c = 1.0
                s = 0.0
                if r > 0.0:
                    c = x / r
                    s = y / r
                zr = c
                zi = s
                bound = mean[i]
                for m in range(n_modes):
                    zr, zi = zr * c - zi * s, zr * s + zi * c
                    bound += re[m] * zr - im[m] * zi
                # A pinched cell has no extent where its radius is not positive.
                ratio = r / (radius[i] * bound) if bound > 0.0 else HALO
                if ratio < nearest[row, column]:
                    nearest[row, column] = ratio
                    if ratio < 1.0:
                        out[row, column] = i + 1
                        u = (x * math.cos(theta[i]) + y * math.sin(theta[i])) / radius[i]
                        v = (y * math.cos(theta[i]) - x * math.sin(theta[i])) / radius[i]
                        shade[row, column] = math.cos(
                            texture[i, 0] * u + texture[i, 1] * v + texture[i, 2]
                        ) * math.cos(texture[i, 3] * u - texture[i, 4] * v)


def render(
    run: Run,
    output: str | Path,
    *,
    pixel_size: float,
    length: float = 10.0,
    time: float = 1.0 / 6.0,
    phase_contrast: str | Path | None = None,
    truth: str | Path | None = None,
    margin: float = 0.0,
    start: int = 0,
    stop: int | None = None,
    step: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> Rendering:
    """Render a run as label masks, as a camera would see it, with its true tracks.

    The field of view is the periodic box, with a margin where one is given, cut at its edges. A
    cell across an edge shows its two parts on opposite sides, with labels of their own, as two
    cells that leave and enter; parts below 8 pixels are not drawn. A pixel inside several cells
    goes to the one in which it lies relatively deepest: the smallest r / R(phi) from the cell's
    centre. Labels are numbered per frame by position in the field, so that they tell nothing of
    identity.

    Parameters
    ----------
    run
        The run.
    output
        The TIFF of the masks.
    pixel_size
        Edge of a pixel, um.
    length
        The unit of length L0 in um.
    time
        The unit of time t0 in min.
    phase_contrast
        A TIFF for a movie that looks like phase contrast (8 bit), or None.
    truth
        Folder of the true tracks and contours; None for `output` with ``_truth`` appended.
    margin
        Width of the strip to the right of the box and below it, in L0, in which the layer is seen
        once more: with that of a cell nearly every cell is whole somewhere in the field.
    start, stop, step
        Frames of the run to render.

    Returns
    -------
    Rendering

    Raises
    ------
    InputError
        If the run holds no such frame, or a cell is smaller than a few pixels.
    """
    output = Path(output)
    for name, value in (("pixel_size", pixel_size), ("length", length), ("time", time)):
        if not (math.isfinite(value) and value > 0.0):
            raise InputError(f"{name} must be a finite number > 0, got {value}; correct it.")
    frames = range(run.n_frames)[start:stop:step]
    if step < 1 or len(frames) == 0:
        raise InputError(
            f"{run.path or 'the run'} holds {run.n_frames} frames, none of them from {start} to "
            f"{stop} in steps of {step}; choose others."
        )
    if not 0.0 <= margin <= min(run.box):
        raise InputError(
            f"margin must be >= 0 L0 and at most the box, {min(run.box):g} L0, got {margin}; "
            "correct it."
        )
    pixel = pixel_size / length
    width, height = (int((side + margin) / pixel) for side in run.box)
    if 2.0 * float(np.median(run.radius)) < 4.0 * pixel:
        raise InputError(
            f"a pixel of {pixel_size:g} um is too coarse for cells of "
            f"{2 * np.median(run.radius) * length:.3g} um; take a smaller pixel_size."
        )
    if width * height > 2**28:
        raise InputError(
            f"a field of {width} x {height} pixels is too large; take a larger pixel_size."
        )
    folder = Path(truth) if truth is not None else output.with_name(output.stem + "_truth")
    painter = _Painter(run, pixel, (height, width), margin)
    masks: list[Labels] = []
    tables: list[pd.DataFrame] = []
    outlines: list[NDArray[np.float32]] = []
    grey: list[NDArray[np.uint8]] = []
    for number, frame in enumerate(frames):
        labels, table, outline = painter.frame(frame)
        masks.append(labels)
        table["frame"] = number
        tables.append(table)
        outlines.append(outline)
        if phase_contrast is not None:
            grey.append(painter.picture(frame))
        if progress is not None:
            progress(number + 1, len(frames))
    interval = float(run.settings["save_every"]) * step * time
    write_labels(output, masks, pixel_size=pixel_size, frame_interval=interval)
    tracks, order = _true_tracks(tables, run, length, interval, (height, width), pixel_size)
    stack: LabelStack = read_labels(output)
    with atomic_path(folder) as partial:
        write_ctc(partial / "TRA", stack, tracks.table)
        tracks.write(partial / "tracks.parquet")
        np.save(partial / "contours.npy", np.concatenate(outlines)[order] * np.float32(length))
    picture = None
    if phase_contrast is not None:
        picture = Path(phase_contrast)
        _write_picture(picture, grey, pixel_size, interval)
    return Rendering(output, folder, picture, tracks, (height, width))


class _Painter:
    """Draws frames of a run; keeps which part of which cell is in the field since when."""

    def __init__(self, run: Run, pixel: float, shape: tuple[int, int], margin: float) -> None:
        self.run, self.pixel, self.shape, self.margin = run, pixel, shape, margin
        rng = np.random.default_rng([run.scene.seed, 3])
        n_cells = len(run.radius)
        waves = rng.normal(0.0, 6.0, (n_cells, 5))
        waves[:, 2] = rng.uniform(0.0, 2.0 * math.pi, n_cells)
        self.texture = waves
        self.grain = rng.normal(0.0, 1.0, shape)
        self.visits: dict[tuple[int, int, int], int] = {}
        self.n_tracks = 0
        self.nearest = np.empty(shape)
        self.shade = np.empty(shape)
        self.last = np.empty(shape, np.int32)

    def frame(self, frame: int) -> tuple[Labels, pd.DataFrame, NDArray[np.float32]]:
        """Masks of a frame, its rows of truth in L0, and the true contours of these rows."""
        state = self.run.state(frame)
        modes = state[:, 3:].reshape(len(state), 2, -1)
        cells, images = self._parts(state)
        place = state[cells, :2] - images * np.array(self.run.box)
        # Numbered by position, rows first: a label tells nothing of which cell it is.
        order = np.lexsort((place[:, 0], np.round(place[:, 1] / 0.5)))
        cells, images, place = cells[order], images[order], place[order]
        self.nearest[:] = HALO
        self.shade[:] = 0.0
        out = np.zeros(self.shape, np.int32)
        draw(
            np.ascontiguousarray(place),
            state[cells, 2],
            self.run.radius[cells],
            mean_radii(modes[cells]),
            np.ascontiguousarray(modes[cells]),
            self.pixel,
            self.texture[cells],
            out,
            self.nearest,
            self.shade,
        )
        self.last = out
        sizes = np.bincount(out.ravel(), minlength=len(cells) + 1)[1:]
        drawn = np.flatnonzero(sizes >= SMALLEST_PART)
        renumber = np.zeros(len(cells) + 1, np.int32)
        renumber[drawn + 1] = np.arange(1, len(drawn) + 1)
        cells, images, place = cells[drawn], images[drawn], place[drawn]
        labels = renumber[out]
        shapes = measure_shapes(modes[cells], state[cells, 2], self.run.radius[cells])
        shapes["x"] = place[:, 0] + shapes.pop("offset_x")
        shapes["y"] = place[:, 1] + shapes.pop("offset_y")
        shapes["label"] = np.arange(1, len(cells) + 1)
        shapes["cell"] = cells
        shapes["track_id"] = self._identify(cells, images)
        edge = np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])
        shapes["touches_border"] = np.isin(shapes["label"], edge)
        shapes["n_neighbours"] = _count_touching(labels, len(cells))
        outline = contours(
            place, modes[cells], state[cells, 2], self.run.radius[cells], CONTOUR_POINTS
        )
        return labels, shapes, outline.astype(np.float32)

    def _parts(self, state: Floats) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Cells and images whose circle of reach meets the field."""
        box = np.array(self.run.box)
        size = np.sqrt(np.sum(state[:, 3:] ** 2, axis=1))
        spread = math.sqrt(max(1, state.shape[1] - 3))
        reach = HALO * self.run.radius * (1.0 + spread * size)
        low = np.floor((state[:, :2] - reach[:, None] - self.margin) / box).astype(np.int64)
        high = np.floor((state[:, :2] + reach[:, None]) / box).astype(np.int64)
        found = [
            (i, ix, iy)
            for i in range(len(state))
            for ix in range(low[i, 0], high[i, 0] + 1)
            for iy in range(low[i, 1], high[i, 1] + 1)
        ]
        parts = np.array(found, np.int64)
        return parts[:, 0], parts[:, 1:]

    def _identify(self, cells: NDArray[np.int64], images: NDArray[np.int64]) -> NDArray[np.int64]:
        """Number of the visit of every part: it goes on while the part is seen in every frame."""
        visits: dict[tuple[int, int, int], int] = {}
        for i, (ix, iy) in zip(cells.tolist(), images.tolist(), strict=True):
            track = self.visits.get((i, ix, iy))
            if track is None:
                self.n_tracks += 1
                track = self.n_tracks
            visits[i, ix, iy] = track
        self.visits = visits
        return np.array(list(visits.values()), np.int64)

    def picture(self, frame: int) -> NDArray[np.uint8]:
        """The frame drawn last as grey values: dark cells, bright halos, some grain."""
        ratio = self.nearest
        inside = self.last > 0
        halo = np.exp(-(((ratio - 1.08) / 0.09) ** 2)) - 0.7 * np.exp(-(((ratio - 0.9) / 0.1) ** 2))
        value = 118.0 + 70.0 * halo + inside * (-14.0 + 10.0 * self.shade)
        value += 3.0 * np.roll(self.grain, frame * 17, axis=1)
        return np.clip(np.round(value), 0, 255).astype(np.uint8)


def _count_touching(labels: Labels, n_labels: int) -> NDArray[np.int64]:
    """Number of other labels that share a pixel edge with each label 1 .. n."""
    pairs = np.concatenate(
        [
            np.stack([labels[:-1].ravel(), labels[1:].ravel()]),
            np.stack([labels[:, :-1].ravel(), labels[:, 1:].ravel()]),
        ],
        axis=1,
    )
    pairs = pairs[:, (pairs[0] != pairs[1]) & (pairs.min(axis=0) > 0)]
    unique = np.unique(np.sort(pairs, axis=0), axis=1)
    return np.bincount(unique.ravel(), minlength=n_labels + 1)[1:].astype(np.int64)


def _true_tracks(
    tables: list[pd.DataFrame],
    run: Run,
    length: float,
    interval: float,
    shape: tuple[int, int],
    pixel_size: float,
) -> tuple[Tracks, NDArray[np.int64]]:
    """The rows of all frames as tracks in um and min, and the order they were put in."""
    table = pd.concat(tables, ignore_index=True)
    for name in ("x", "y", "perimeter"):
        table[name] *= length
    table["area"] *= length**2
    table["parent_track_id"] = 0
    table["time"] = table["frame"] * interval
    order = np.lexsort((table["frame"], table["track_id"]))
    table = table.iloc[order].reset_index(drop=True)
    columns = [*TRACK_COLUMNS, "cell"]
    tracks = Tracks(
        table=table[columns].astype(dict(TRACK_COLUMNS)),
        units=PHYSICAL,
        frame_interval=interval,
        area=shape[0] * shape[1] * pixel_size**2,
        provenance={"source": "rendered simulation", "scene": run.scene.to_dict()},
    )
    return tracks, order.astype(np.int64)


def _write_picture(
    path: Path, frames: list[NDArray[np.uint8]], pixel_size: float, interval: float
) -> None:
    def pages() -> Iterator[NDArray[np.uint8]]:
        yield from frames

    with atomic_path(path) as temporary:
        tifffile.imwrite(
            temporary,
            pages(),
            shape=(len(frames), *frames[0].shape),
            dtype=np.uint8,
            compression="zlib",
            ome=True,
            metadata={
                "axes": "TYX",
                "PhysicalSizeX": pixel_size,
                "PhysicalSizeXUnit": "µm",
                "PhysicalSizeY": pixel_size,
                "PhysicalSizeYUnit": "µm",
                "TimeIncrement": interval * 60.0,
                "TimeIncrementUnit": "s",
                "UUID": "urn:uuid:00000000-0000-0000-0000-000000000000",
            },
        )

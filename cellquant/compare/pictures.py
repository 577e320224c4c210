"""Pictures of a layer: segmented frames, a simulated snapshot, and the paths of the cells."""

import base64
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from cellquant.compare.results import unit_text
from cellquant.compare.svg import (
    N_SERIES,
    canvas,
    colour,
    compact_path,
    follow_theme,
    series_colour,
    to_svg,
)
from cellquant.tables import Units

if TYPE_CHECKING:
    import pandas as pd

    from cellquant.sim import Run

FloatArray = np.ndarray[Any, np.dtype[np.float64]]
IntArray = np.ndarray[Any, np.dtype[np.integer[Any]]]
MAX_PIXELS = 900
MAX_STEP_PIXELS = 450
STEP_PIXELS = 360  # of the steps on a page with many layers
MAX_POINTS = 12_000
# Twelve tones of like lightness, readable on light and on dark ground (RGB).
_TONES = np.array(
    [
        (121, 167, 211), (222, 155, 112), (117, 185, 165), (176, 150, 210),
        (205, 176, 104), (214, 140, 160), (140, 186, 120), (146, 161, 222),
        (219, 168, 136), (108, 180, 197), (191, 160, 187), (176, 179, 126),
    ],
    dtype=np.uint8,
)  # fmt: skip
_PALE = np.array([190, 190, 186], dtype=np.uint8)  # of a cell without a track


@dataclass(frozen=True)
class MaskFrame:
    """One frame to draw.

    Attributes
    ----------
    labels
        (H, W) label masks, 0 for background.
    title
        What is said of the frame where several are shown in turn.
    raw
        (H, W) recorded image; when given, it is shown in grey with the outlines of the cells.
    identities
        Track of each label: a cell then keeps its colour through the movie, and one without a
        track is grey; labels choose the colours when None.
    """

    labels: IntArray
    title: str = ""
    raw: np.ndarray[Any, Any] | None = None
    identities: Mapping[int, int] | None = None


def draw_masks(
    frames: Sequence[MaskFrame],
    *,
    shown: int = 0,
    pixel_size: float,
    units: Units,
    step_pixels: int = MAX_STEP_PIXELS,
) -> str:
    """Draw label masks with a scale bar, as an ``<svg>`` element.

    Parameters
    ----------
    frames
        The frames, of equal size; with more than one the page lets the reader step through them.
    shown
        Which of them is seen first, in print, and without scripts.
    pixel_size
        Edge of a pixel, in ``units.length``.
    units
        Unit names, for the scale bar.
    step_pixels
        Pixels along an edge of the frames that are not seen first, at most.

    Returns
    -------
    str
        The element; the picture seen first has at most `MAX_PIXELS` pixels along an edge.
    """
    height, width = frames[shown].labels.shape
    if len(frames) == 1:
        body = _mask_image(frames[0], MAX_PIXELS)
    else:
        body = "".join(
            _step(
                frame.title,
                _mask_image(frame, MAX_PIXELS if number == shown else step_pixels),
                hidden=number != shown,
            )
            for number, frame in enumerate(frames)
        )
    return _framed(body, width, height, scale=1 / pixel_size, length_unit=units.length)


def _step(title: str, image: str, *, hidden: bool) -> str:
    display = ' display="none"' if hidden else ""
    return f'<g class="step" data-title="{escape(title)}"{display}>{image}</g>'


def _mask_image(frame: MaskFrame, limit: int) -> str:
    height, width = frame.labels.shape
    step = max(1, math.ceil(max(height, width) / limit))
    seen = np.ascontiguousarray(frame.labels[::step, ::step])
    tones = _tones_of(seen, frame.identities)
    inside = seen > 0
    edge = _edges(seen)
    if frame.raw is None:
        picture = np.dstack([tones, np.where(inside, 255, 0).astype(np.uint8)])
        picture[edge, :3] = (picture[edge, :3] * 0.55).astype(np.uint8)
        data, kind = _encode(picture, ".png"), "png"
    else:
        grey = _to_grey(frame.raw[::step, ::step])
        picture = np.dstack([grey, grey, grey])
        picture[edge] = tones[edge]
        data, kind = _encode(picture, ".jpg"), "jpeg"
    return _image(data, kind, width, height)


def _image(data: bytes, kind: str, width: float, height: float) -> str:
    return (
        f'<image width="{width:g}" height="{height:g}" preserveAspectRatio="none" '
        f'href="data:image/{kind};base64,{base64.b64encode(data).decode()}"/>'
    )


def draw_contours(
    contours: FloatArray,
    box: tuple[float, float],
    *,
    units: Units,
    title: str = "",
    earlier: Sequence[tuple[str, FloatArray]] = (),
) -> str:
    """Draw the contours of a simulated layer in its periodic box, as an ``<svg>`` element.

    Parameters
    ----------
    contours
        (N, K, 2) contour points of each cell, in ``units.length``.
    box
        Edges of the periodic box.
    units
        Unit names, for the scale bar.
    title
        What is said of this moment where the reader can step through several.
    earlier
        Title and contours of other moments, drawn as pictures of few pixels.
    """
    size = 600.0
    scale = size / max(box)
    width, height = box[0] * scale, box[1] * scale
    groups: dict[int, list[str]] = {}
    for number, points in _in_box(contours, box):
        text = " L ".join(f"{px} {py}" for px, py in points * scale)
        groups.setdefault(_tone(number), []).append(compact_path(f"M {text} z"))
    paths = "".join(
        f'<path d="{"".join(groups[tone])}" fill="{_hex(tone)}" stroke="{_hex(tone, 0.55)}"/>'
        for tone in sorted(groups)
    )
    body = f'<g fill-opacity=".82" stroke-width="1" stroke-linejoin="round">{paths}</g>'
    if earlier:
        steps = [
            _step(text, _contour_image(shape, box, width, height), hidden=True)
            for text, shape in earlier
        ]
        body = "".join([*steps, _step(title, body, hidden=False)])
    return _framed(body, width, height, scale=scale, length_unit=units.length)


def _in_box(contours: FloatArray, box: tuple[float, float]) -> Iterator[tuple[int, FloatArray]]:
    """Number and contour of every cell in the periodic box, once for each edge that it crosses."""
    for number, contour in enumerate(contours):
        home = contour - np.floor(contour.mean(axis=0) / box) * box
        low, high = home.min(axis=0), home.max(axis=0)
        shifts = [
            [0.0, *([edge] if low[axis] < 0 else []), *([-edge] if high[axis] > edge else [])]
            for axis, edge in enumerate(box)
        ]
        for shift_x in shifts[0]:
            for shift_y in shifts[1]:
                yield number, home + np.array([shift_x, shift_y])


def _contour_image(
    contours: FloatArray, box: tuple[float, float], width: float, height: float
) -> str:
    """Contours as a picture of few pixels, in the colours and the frame of `draw_contours`."""
    import cv2

    pixels = [max(1, round(STEP_PIXELS * edge / max(box))) for edge in box]
    picture = np.zeros((pixels[1], pixels[0], 4), dtype=np.uint8)
    fine = 4  # binary digits of a pixel that cv2 reads
    for number, points in _in_box(contours, box):
        tone = _TONES[_tone(number)]
        corners = np.round(points / box * pixels * 2**fine).astype(np.int32)[None]
        cv2.fillPoly(picture, corners, (*tone.tolist(), 209), shift=fine)
        cv2.polylines(picture, corners, True, (*(0.55 * tone).astype(int).tolist(), 255),
                      shift=fine)  # fmt: skip
    return _image(_encode(picture, ".png"), "png", width, height)


def contours_of(
    run: "Run", *, frame: int = -1, points: int = 32
) -> tuple[FloatArray, tuple[float, float]]:
    """Contours (N, K, 2) of the cells in a saved state of a run, by default the last; its box."""
    from cellquant.sim.shapes import contours

    polarity, radius = run.polarity[frame], run.radius
    outlines = contours(run.position[frame], run.modes[frame], polarity, radius, points)
    box = np.asarray(run.box, dtype=np.float64)
    return outlines, (float(box[0]), float(box[1]))


def thin_paths(table: "pd.DataFrame", *, max_points: int = MAX_POINTS) -> "pd.DataFrame":
    """Keep as many points of the trajectories as a drawing can show.

    Tracks are thinned to every k-th frame with their first and last point, down to about eight
    points of the longest. Where that is not enough the longest tracks are kept, of equally long
    ones some from everywhere.

    Returns
    -------
    pandas.DataFrame
        Columns track_id, frame, x, y, in the order of track and frame.
    """
    rows = table[["track_id", "frame", "x", "y"]].sort_values(["track_id", "frame"])
    group = rows.groupby("track_id", sort=False)
    rank, length = group.cumcount(), group["frame"].transform("size")
    paths = length > 1
    rows, rank, length = rows[paths], rank[paths], length[paths]
    every, coarsest = 1, length.max() / 8 if len(rows) else 0
    chosen = rank >= 0
    while chosen.sum() > max_points and every < coarsest:
        every += 1
        chosen = (rank % every == 0) | (rank == length - 1)
    rows = rows[chosen]
    sizes = rows.groupby("track_id").size()
    order = np.lexsort([_scrambled(sizes.index.to_numpy(np.int64)), -sizes.to_numpy()])
    sizes = sizes.iloc[order]
    kept = sizes.index[sizes.cumsum() <= max_points]
    return rows[rows["track_id"].isin(kept)].reset_index(drop=True)


def draw_paths(
    paths: "pd.DataFrame",
    name: str,
    *,
    units: Units,
    window: tuple[float, float, float, float],
    frame: tuple[float, float, float, float] | None = None,
) -> str:
    """Draw trajectories as seen in the image (y downwards), as an ``<svg>`` element.

    Parameters
    ----------
    paths
        Columns track_id, frame, x, y.
    name
        Name of the drawing on its page.
    units
        Unit names for the axes.
    window
        x from, x to, y from, y to of the part shown.
    frame
        The same, of a rectangle to mark.
    """
    from matplotlib.collections import LineCollection
    from matplotlib.patches import Rectangle

    left, right, low, high = window
    with canvas(height=4.8) as (figure, axes):
        inside = paths["x"].between(left, right) & paths["y"].between(low, high)
        shown = paths[paths["track_id"].isin(paths.loc[inside, "track_id"].unique())]
        for series in range(N_SERIES):
            lines = [
                track[["x", "y"]].to_numpy()
                for _, track in shown[shown["track_id"] % N_SERIES == series].groupby("track_id")
            ]
            axes.add_collection(LineCollection(lines, colors=series_colour(series), linewidths=0.8))
            ends = [line[-1] for line in lines]
            if ends and shown["track_id"].nunique() < 400:
                axes.plot(*np.transpose(ends), ".", color=series_colour(series), markersize=3)
        if frame is not None:
            a, b, c, d = frame
            axes.add_patch(
                Rectangle((a, c), b - a, d - c, fill=False, edgecolor=colour("ink"), linewidth=1.2)
            )
        axes.set_xlim(left, right)
        axes.set_ylim(high, low)
        axes.set_aspect("equal", adjustable="box", anchor="NW")
        unit = unit_text((1, 0), units)
        axes.set_xlabel(f"x ({unit})")
        axes.set_ylabel(f"y ({unit})")
        for side in ("top", "right"):
            axes.spines[side].set_visible(True)
        return to_svg(figure, name)


def _framed(body: str, width: float, height: float, *, scale: float, length_unit: str) -> str:
    """Put a picture above its scale bar; `scale` is drawing units per length unit."""
    bar = _round_length(width / scale / 5)
    length = bar * scale
    size = max(width, height) / 26
    label = escape(f"{bar:g} {length_unit.replace('um', 'µm').replace('L0', 'L₀')}")
    ink = colour("ink")
    return follow_theme(
        f'<svg xmlns="http://www.w3.org/2000/svg" '
        f'viewBox="0 0 {width:g} {height + 1.9 * size:g}">'
        f'<svg width="{width:g}" height="{height:g}" viewBox="0 0 {width:g} {height:g}">'
        f"{body}</svg>"
        f'<rect width="{width:g}" height="{height:g}" '
        f'style="fill: none; stroke: {colour("rule")}; stroke-width: {size / 14:.2f}"/>'
        f'<rect y="{height + 0.95 * size:g}" width="{length:.1f}" height="{size / 4:.1f}" '
        f'style="fill: {ink}"/>'
        f'<text x="{length + size / 2:.1f}" y="{height + 1.42 * size:.1f}" '
        f'style="fill: {ink}; font-family: sans-serif; font-size: {size:.1f}px">{label}</text>'
        f"</svg>"
    )


def _round_length(length: float) -> float:
    power = 10.0 ** math.floor(math.log10(length))
    return max(m for m in (1.0, 2.0, 5.0) if m * power <= length * (1 + 1e-9)) * power


def _tone(identity: int) -> int:
    return int(_scrambled(identity)) * len(_TONES) >> 32


def _scrambled(identity: Any) -> Any:
    """Whole numbers below 2**32 that are far apart where the given ones are neighbours."""
    return identity * 2654435761 % 2**32


def _hex(tone: int, factor: float = 1.0) -> str:
    return "#" + "".join(f"{int(c * factor):02x}" for c in _TONES[tone])


def _tones_of(
    labels: IntArray, identities: Mapping[int, int] | None
) -> np.ndarray[Any, np.dtype[np.uint8]]:
    present, inverse = np.unique(labels, return_inverse=True)
    if identities is None:
        tones = np.array([_TONES[_tone(int(v))] for v in present], dtype=np.uint8)
    else:
        tones = np.array(
            [_TONES[_tone(identities[v])] if v in identities else _PALE for v in present.tolist()],
            dtype=np.uint8,
        )
    tones[present <= 0] = 0
    out: np.ndarray[Any, np.dtype[np.uint8]] = tones[inverse.reshape(labels.shape)]
    return out


def _edges(labels: IntArray) -> np.ndarray[Any, np.dtype[np.bool_]]:
    edge = np.zeros(labels.shape, dtype=bool)
    edge[:-1] |= labels[:-1] != labels[1:]
    edge[:, :-1] |= labels[:, :-1] != labels[:, 1:]
    return edge


def _to_grey(raw: np.ndarray[Any, Any]) -> np.ndarray[Any, np.dtype[np.uint8]]:
    low, high = np.percentile(raw, (0.5, 99.5))
    span = float(high - low) or 1.0
    grey: np.ndarray[Any, np.dtype[np.uint8]] = (
        np.clip((raw.astype(np.float64) - low) / span, 0, 1) * 255
    ).astype(np.uint8)
    return grey


def _encode(picture: np.ndarray[Any, np.dtype[np.uint8]], suffix: str) -> bytes:
    import cv2

    order = [2, 1, 0, 3][: picture.shape[2]]
    options = (
        [cv2.IMWRITE_PNG_COMPRESSION, 9] if suffix == ".png" else [cv2.IMWRITE_JPEG_QUALITY, 78]
    )
    done, data = cv2.imencode(suffix, np.ascontiguousarray(picture[..., order]), options)
    if not done:
        raise ValueError(f"could not encode a picture of shape {picture.shape} as {suffix}")
    return bytes(data.tobytes())

"""The layers of a comparison: moments of both sides, and the paths of their cells."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from cellquant.compare.groups import Group
from cellquant.compare.page import Figure, Panel
from cellquant.compare.sources import with_sources

if TYPE_CHECKING:
    import pandas as pd

    from cellquant.compare.pictures import MaskFrame
    from cellquant.io import LabelStack

MAX_PICTURES = 3
MAX_PATH_POINTS = 2500
MAX_CORNERS = 20_000  # of all contours in one drawing
MAX_MOMENTS = 5  # of a layer to step through
MOMENT_BYTES = 75.0  # of one cell in a picture that is stepped to, measured
MAX_MOMENT_BYTES = 600_000.0  # of all those of a page
ALL = 2**31  # frames, more than any recording has
SQUARE = 8.0  # mean diameters, edge of the enlarged part of the trajectories


def layer_figure(groups: Sequence[Group]) -> Figure | None:
    """Segmented frames of a movie beside snapshots of the model, to step through."""
    from cellquant.compare.pictures import STEP_PIXELS, contours_of, draw_contours, draw_masks

    panels = []
    pictured = with_pictures(groups)
    cells = [group.members[0].summary.get("n_cells_mean") or 0.0 for group in pictured]
    moments = n_moments(sum(cells))
    for index, group in enumerate(pictured):
        result = group.members[0]
        name = f"layer-{index + 1}"
        if result.stack is not None:
            frames = _mask_frames(group, result.stack, moments)
            calibration = result.stack.calibration
            svg = draw_masks(
                frames,
                shown=len(frames) - 1,
                pixel_size=calibration.pixel_size,
                units=calibration.units,
                step_pixels=STEP_PIXELS,
            )
            words = (
                f"Segmented cells of {group.name} in different colours at {frames[-1].title}, the "
                "last frame."
            )
        elif result.run is not None:
            run = result.run
            times = np.asarray(run.time, dtype=np.float64)
            interval = float(times[1] - times[0]) if times.size > 1 else 1.0
            titles = {
                frame: f"t = {times[frame] - times[0]:g} t₀"
                for frame in _steps(group, times.size, interval, moments)
            }
            *others, last = titles
            svg = draw_contours(
                *contours_of(run, points=int(np.clip(MAX_CORNERS // len(run.radius), 12, 32))),
                units=result.units,
                title=titles[last],
                earlier=[(titles[f], contours_of(run, frame=f, points=20)[0]) for f in others],
            )
            words = f"Contours of all cells of {group.name} at the end of the run."
        else:
            continue
        panels.append(Panel(name, svg, words, group.name))
    if not panels:
        return None
    return Figure(
        name="layer",
        title="The layer at work",
        caption="The first recording of each group at its end; step back through the two "
        "relaxation times before, or the whole recording where τ_{α} is not known or it is "
        "shorter. Movies: segmented cells. Simulations: contours of all cells; the layer continues "
        "periodically at its edges. A cell keeps its colour; grey ones are not followed.",
        panels=tuple(panels),
        wide=True,
    )


def n_moments(n_cells: float) -> int:
    """Moments of every layer that a page has room for, with this many cells in one of each."""
    room = MAX_MOMENT_BYTES / (MOMENT_BYTES * max(n_cells, 1.0))
    return 1 + int(min(room, MAX_MOMENTS - 1))


def _steps(group: Group, n_frames: int, interval: float, moments: int) -> list[int]:
    """Up to so many frames, evenly over the last two relaxation times, the last included."""
    last = n_frames - 1
    first = max(0, last - _two_relaxations(group, interval)) if last else 0
    if moments == 1:
        return [last]
    return sorted(set(np.linspace(first, last, moments).round().astype(int).tolist()))


def _mask_frames(group: Group, stack: "LabelStack", moments: int) -> "list[MaskFrame]":
    from cellquant.compare.pictures import MaskFrame

    tracks = group.members[0].tracks
    frames = []
    for index in _steps(group, len(stack), stack.calibration.frame_interval, moments):
        number = stack.frame_numbers[index]
        title, known = f"frame {number}", None
        if tracks is not None:
            here = tracks.table[tracks.table["frame"] == number]
            known = dict(zip(here["label"].tolist(), here["track_id"].tolist(), strict=True))
            if tracks.units.time != "frame":
                title = f"t = {number * tracks.frame_interval:g} {tracks.units.time}"
        frames.append(MaskFrame(stack[index], title, identities=known))
    return frames


def path_figures(groups: Sequence[Group]) -> list[Figure]:
    """Trajectories of the whole layer, and a window of the same size in cell diameters."""
    import pandas as pd

    from cellquant.compare.pictures import draw_paths, thin_paths
    from cellquant.tables import Units

    views: dict[str, list[Panel]] = {"whole": [], "close": []}
    data: dict[str, list[pd.DataFrame]] = {"whole": [], "close": []}
    for index, group in enumerate(with_pictures(groups)):
        tracks = group.members[0].tracks
        d = group.scalars().get("wave_number.mean_diameter")
        if tracks is None or d is None or tracks.table.empty:
            continue
        table = tracks.table[["track_id", "frame", "x", "y"]].copy()
        table[["x", "y"]] /= d.value
        recent, span = _recent(table, group, tracks.frame_interval)
        if tracks.box is None:
            low, high = table[["x", "y"]].min().to_numpy(), table[["x", "y"]].max().to_numpy()
        else:
            low, high = np.zeros(2), np.array(tracks.box) / d.value
            ends = recent.groupby("track_id")[["x", "y"]].transform("last")
            recent = recent.assign(**(recent[["x", "y"]] - np.floor(ends / high) * high))
        middle = 0.5 * (low + high)
        square = (middle[0] - SQUARE / 2, middle[0] + SQUARE / 2,
                  middle[1] - SQUARE / 2, middle[1] + SQUARE / 2)  # fmt: skip
        inside = recent["x"].between(*square[:2]) & recent["y"].between(*square[2:])
        near = recent[recent["track_id"].isin(recent.loc[inside, "track_id"].unique())]
        units = Units("d", tracks.units.time)
        for view, chosen, window in (
            ("whole", recent, (low[0], high[0], low[1], high[1])),
            ("close", near, square),
        ):
            paths = thin_paths(chosen, max_points=MAX_PATH_POINTS)
            if paths.empty:
                continue
            name = f"paths-{view}-{index + 1}"
            svg = draw_paths(paths, name, units=units, window=window,
                             frame=square if view == "whole" else None)  # fmt: skip
            shown = "in the marked square" if view == "close" else "in view"
            words = f"Paths of the cells of {group.name} {shown}, over {span}."
            views[view].append(Panel(name, svg, words, group.name))
            # Short rows: these are the longest tables of the page.
            data[view].append(paths.round({"x": 3, "y": 3}).assign(drawing=len(views[view])))
    captions = {
        "whole": (
            "Trajectories",
            "The last two relaxation times, or the whole recording where τ_{α} is not known or the "
            "recording is shorter. Dots mark where the paths end; lengths are in mean cell "
            "diameters d. Of a simulated layer, which is periodic, one period is shown. The marked "
            "square is enlarged below. In the CSV, drawing counts from 1.",
        ),
        "close": (
            "Trajectories, enlarged to the same scale",
            f"A square of {SQUARE:g} by {SQUARE:g} cell diameters on every side, so that paths can "
            "be compared by eye.",
        ),
    }
    return [
        Figure(f"paths-{view}", *captions[view], tuple(panels),
               pd.concat(data[view], ignore_index=True), wide=True)
        for view, panels in views.items() if panels
    ]  # fmt: skip


def _recent(
    table: "pd.DataFrame", group: Group, frame_interval: float
) -> "tuple[pd.DataFrame, str]":
    """The part of the trajectories that lies in the last two relaxation times."""
    span = _two_relaxations(group, frame_interval)
    known = span < ALL
    words = "the last two relaxation times" if known else "the whole recording"
    return table[table["frame"] > table["frame"].max() - span] if known else table, words


def _two_relaxations(group: Group, frame_interval: float) -> int:
    """Two relaxation times in frames; `ALL` where the relaxation time is not known."""
    tau = group.scalars().get("tau_alpha.value")
    if tau is None or not math.isfinite(tau.value):
        return ALL
    return max(2, round(2 * tau.value / frame_interval))


def add_sources(groups: Sequence[Group]) -> list[Group]:
    """Add trajectories, masks and runs to the groups whose pictures will be shown."""
    taken = {False: 0, True: 0}
    out = []
    for group in groups:
        taken[group.simulated] += 1
        if taken[group.simulated] > MAX_PICTURES:
            out.append(group)
            continue
        first, *rest = group.trials.items()
        head = (with_sources(first[1][0]), *first[1][1:])
        out.append(replace(group, trials={first[0]: head, **dict(rest)}))
    return out


def with_pictures(groups: Sequence[Group]) -> list[Group]:
    """The first few groups of each side that have something to show."""
    shown = []
    for simulated in (False, True):
        shown += [g for g in groups if g.simulated is simulated][:MAX_PICTURES]
    return [g for g in shown if g.members[0].tracks is not None]

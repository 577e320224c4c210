"""What tracking chose and how far it can be trusted."""

from typing import Any

import numpy as np

from cellquant.track.fates import INSIDE
from cellquant.track.movie import Movie
from cellquant.track.solve import Solution

_AMBIGUOUS = 0.95


def describe(movie: Movie, solution: Solution, unit: str, *, n_gaps: int) -> dict[str, Any]:
    """Report of a linked movie, ready for JSON."""
    links, motion = solution.links, solution.motion
    assert links is not None
    linked = np.flatnonzero(links.before >= 0)
    frames = np.searchsorted(movie.start, np.arange(movie.n_cells), side="right") - 1
    step = np.hypot(*(movie.position[linked] - movie.position[links.before[linked]]).T)
    spacing = movie.spacing[frames[linked]]
    ratio = step / spacing
    confidence = links.confidence[linked]
    ambiguous = float(np.mean(confidence < _AMBIGUOUS)) if len(linked) else 0.0
    kind = int(np.argmax(np.bincount(_kinds(solution), minlength=4)))
    scale, tail = float(motion.scale[kind]), float(motion.tail[kind])
    reach, typical = _reach(movie, solution, scale, tail)
    last, first = movie.start[-2], movie.start[1]
    report: dict[str, Any] = {
        "search_range": reach,
        "search_range_reason": (
            f"steps scatter by {scale:.3g} {unit} around their prediction; a step that misses it "
            f"by more than {reach:.3g} {unit} is less likely than one cell vanishing and another "
            f"appearing (typical spacing {typical:.3g} {unit})"
        ),
        "displacement": {
            "unit": unit,
            "quantiles": [0.5, 0.9, 0.99],
            "values": _quantiles(step),
            "over_spacing": _quantiles(ratio),
            "spacing": typical,
            "histogram_edges": [round(0.1 * i, 1) for i in range(16)],
            "histogram": np.histogram(ratio, bins=0.1 * np.arange(16))[0].tolist(),
        },
        "prediction": {
            "scatter": scale,
            "tail": tail,
            "own_path_weight": float(motion.coefficients[2, 5]),
            "shape_memory": [float(v) for v in solution.shapes.memory],
        },
        "ambiguous_links": ambiguous,
        "links": len(linked),
        "births": int(np.sum(links.before[first:] < 0)) - n_gaps,
        "deaths": int(np.sum(links.after[:last] < 0)) - n_gaps,
        "gaps_closed": n_gaps,
        "divisions": int(np.sum(links.second >= 0)),
    }
    report["warnings"] = _warnings(ambiguous, scale, typical, linked, movie)
    return report


def _kinds(solution: Solution) -> np.ndarray[Any, np.dtype[np.int64]]:
    links = solution.links
    assert links is not None
    source = np.flatnonzero(links.after >= 0)
    target = links.after[source]
    kinds: np.ndarray[Any, np.dtype[np.int64]] = (
        2 * solution.known.has_before[source] + solution.known.has_after[target]
    )
    return kinds


def _reach(movie: Movie, solution: Solution, scale: float, tail: float) -> tuple[float, float]:
    """Distance from the prediction at which a link inside loses to vanishing and appearing."""
    rates = solution.rates
    density = float(np.median(movie.density))
    vanish, appear = rates.vanish[:-1, INSIDE].mean(), rates.appear[1:, INSIDE].mean()
    best = -np.log(2 * np.pi * scale**2) + np.log1p(-vanish) - np.log(vanish * appear * density)
    spread = np.expm1(max(float(best), 0.0) / (tail / 2 + 1))
    return float(scale * np.sqrt(tail * spread)), float(np.median(movie.spacing))


def _quantiles(values: np.ndarray[Any, np.dtype[np.float64]]) -> list[float]:
    if len(values) == 0:
        return []
    return [float(v) for v in np.quantile(values, (0.5, 0.9, 0.99))]


def _warnings(
    ambiguous: float,
    scale: float,
    spacing: float,
    linked: np.ndarray[Any, np.dtype[np.int64]],
    movie: Movie,
) -> list[str]:
    texts = []
    if scale > 0.25 * spacing or ambiguous > 0.15:
        texts.append(
            f"the frame interval is long for this motion: steps scatter by {scale / spacing:.2f} "
            f"of the spacing around their prediction and {ambiguous:.0%} of the links are "
            "ambiguous; record more often, or trust short times only"
        )
    if len(linked) < 0.5 * (movie.n_cells - (movie.start[1] - movie.start[0])):
        texts.append(
            "fewer than half of the cells were found again in the next frame; check that the "
            "masks are in order of time, and the longest step allowed if one was given"
        )
    missing = movie.time[1:][np.diff(movie.time) > 1]
    if len(missing):
        texts.append(
            f"frames without cells before frame {', '.join(str(t) for t in missing[:5])}; "
            "links across them assume the same motion per frame"
        )
    return texts

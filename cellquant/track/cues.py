"""Image cues as log odds: what a correct link looks like, against a wrong one as near."""

from dataclasses import dataclass

import numpy as np

from cellquant.track.movie import BoolArray, FloatArray, IntArray

_STRATA = 8  # of the distance up to 1; the last holds the rest
_LIMIT = 6.0
_PRIOR = 10.0
_ENOUGH = 30
_FLOOR = 0.02
_RIDGE = 1e-6
_TAIL = 5.0


@dataclass(frozen=True)
class Look:
    """One measurement of the likeness of L pairs of cells.

    ``value`` (L,), greater for pairs that are more alike, NaN where not measured; ``context``
    (L, C) what it depends on in any pair; ``distance`` (L,) from the expected place, in roots of
    the cell's area.
    """

    value: FloatArray
    context: FloatArray
    distance: FloatArray

    def __getitem__(self, rows: IntArray | BoolArray) -> "Look":
        return Look(self.value[rows], self.context[rows], self.distance[rows])


def joined(looks: list[Look]) -> Look:
    """Several looks, at least one, one after the other."""
    return Look(
        np.concatenate([look.value for look in looks]),
        np.concatenate([look.context for look in looks]),
        np.concatenate([look.distance for look in looks]),
    )


@dataclass(frozen=True)
class Cue:
    """Log odds linear in a measurement, given a context that explains part of it.

    ``expected`` (C,) of links and strangers between them, ``weight`` per unit.
    """

    expected: FloatArray
    weight: float

    def odds(self, look: Look) -> FloatArray:
        """Log odds (L,); 0 where nothing was measured."""
        odds = self.weight * (look.value - look.context @ self.expected)
        return np.clip(np.where(np.isnan(odds), 0.0, odds), -_LIMIT, _LIMIT)


def fit_cue(look: Look, linked: BoolArray, stranger: BoolArray) -> Cue | None:
    """Fit a cue to the present links; None where there are too few links or strangers.

    Links and strangers follow the same regression on the context up to one offset, so that what
    the context explains never counts as evidence. Links count alike at any distance, strangers
    where there are links as far; a stranger is never more alike. The offset over the variance
    around the regression is the weight (linear discriminant).

    Parameters
    ----------
    look
        L pairs.
    linked, stranger
        (L,) pairs that are linked, and pairs that are certainly not.
    """
    known = np.isfinite(look.value)
    use = np.flatnonzero(known & (linked | stranger))
    y, x, kind = look.value[use], look.context[use], linked[use]
    stratum = np.minimum((look.distance[use] * _STRATA).astype(np.int64), _STRATA - 1)
    links = np.bincount(stratum[kind], minlength=_STRATA).astype(np.float64)
    strangers = np.bincount(stratum[~kind], minlength=_STRATA).astype(np.float64)
    matched = links * strangers / np.maximum(links + strangers, 1.0)
    if matched.sum() < _ENOUGH:
        return None
    even = np.where(kind, 1.0, (matched / np.maximum(strangers, 1.0))[stratum])
    design = np.column_stack((x, np.where(kind, 0.5, -0.5)))
    ridge = _RIDGE * np.eye(design.shape[1])
    coefficient, variance = np.zeros(design.shape[1]), 1.0
    weight = even
    for _ in range(4):
        weighted = weight[:, None] * design
        coefficient = np.linalg.solve(weighted.T @ design + ridge, weighted.T @ y)
        square = (y - design @ coefficient) ** 2
        # Both kinds count alike for the scatter, however many there are.
        each = [float(weight[k] @ square[k] / weight[k].sum()) for k in (kind, ~kind)]
        variance = (each[0] + each[1]) / 2 + _FLOOR**2
        weight = even * (_TAIL + 1.0) / (_TAIL + square / variance)
    offset = max(float(coefficient[-1]), 0.0) * matched.sum() / (matched.sum() + _PRIOR)
    return Cue(coefficient[:-1], float(offset / variance))


def evidence(cues: list[Cue | None], looks: list[Look]) -> FloatArray:
    """Summed log odds (L,) of the cues that could be fitted, each of its own look."""
    total = np.zeros(len(looks[0].value))
    for cue, look in zip(cues, looks, strict=False):
        if cue is not None:
            total += cue.odds(look)
    return total

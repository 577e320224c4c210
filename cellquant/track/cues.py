"""Image cues as log odds: what a correct link looks like, against a wrong one as near."""

from dataclasses import dataclass

import numpy as np

from cellquant.track.movie import BoolArray, FloatArray

STRATA = 8  # columns of the context that say how far the cell is from its expected place
_LIMIT = 6.0
_PRIOR = 10.0
_ENOUGH = 30
_FLOOR = 0.05


@dataclass(frozen=True)
class Cue:
    """Linear log odds of several measurements, given a context that explains part of them.

    ``expected`` (C, Y) mean of both kinds of pairs, ``weight`` (Y,), ``seen`` (C,) the strata in
    which both kinds occur.
    """

    expected: FloatArray
    weight: FloatArray
    seen: FloatArray

    def odds(self, value: FloatArray, context: FloatArray) -> FloatArray:
        """Log odds (...) of values (..., Y) in contexts (..., C); 0 where nothing is known."""
        odds = (value - context @ self.expected) @ self.weight
        unknown = np.isnan(odds) | (context @ self.seen == 0.0)
        return np.clip(np.where(unknown, 0.0, odds), -_LIMIT, _LIMIT)


def fit_cue(
    value: FloatArray, context: FloatArray, linked: BoolArray, stranger: BoolArray
) -> Cue | None:
    """Fit a cue to the present links; None where there are too few links or strangers.

    Links and strangers are compared within strata of equal distance, and both follow the same
    regression on the rest of the context up to one offset, so that what the context explains can
    never count as evidence; the offset gives the weights (linear discriminant).

    Parameters
    ----------
    value
        (L, Y) measurements, NaN where not made.
    context
        (L, C) what they depend on in any pair; the first `STRATA` columns hold one 1.
    linked, stranger
        (L,) pairs that are linked, and pairs that are certainly not.
    """
    known = np.isfinite(value).all(axis=1)
    use = known & (linked | stranger)
    y, x, kind = value[use], context[use], linked[use]
    count = np.array([x[kind, :STRATA].sum(axis=0), x[~kind, :STRATA].sum(axis=0)])
    matched = count[0] * count[1] / np.maximum(count[0] + count[1], 1.0)
    if matched.sum() < _ENOUGH:
        return None
    stratum = np.argmax(x[:, :STRATA], axis=1)
    even = matched[stratum] / np.where(kind, count[0][stratum], count[1][stratum])
    weight = even
    design = np.column_stack((x, np.where(kind, 0.5, -0.5)))
    ridge = 1e-6 * np.eye(design.shape[1])
    coefficient, scatter = np.zeros((design.shape[1], y.shape[1])), np.eye(y.shape[1])
    for _ in range(4):
        weighted = weight[:, None] * design
        coefficient = np.linalg.solve(weighted.T @ design + ridge, weighted.T @ y)
        rest = y - design @ coefficient
        scatter = (weight[:, None] * rest).T @ rest / weight.sum()
        scatter += _FLOOR**2 * np.eye(y.shape[1])
        distance = np.einsum("ly,yz,lz->l", rest, np.linalg.inv(scatter), rest)
        weight = even * 6.0 / (5.0 + distance)
    offset = coefficient[-1] * matched.sum() / (matched.sum() + _PRIOR)
    seen = np.zeros(x.shape[1])
    seen[:STRATA] = matched >= 2.0
    return Cue(coefficient[:-1], np.linalg.solve(scatter, offset), seen)

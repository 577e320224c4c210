"""How wide credible regions must be, so that they hold the truth as often as they say.

Every scene of a sweep is in turn left out, taken for a layer of unknown parameters and estimated
from the others. Where the regions of probability P hold fewer than a share P of these scenes, all
errors are widened until they do: the regions are calibrated on cases whose truth is known.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

FloatArray = np.ndarray[Any, np.dtype[np.float64]]
LEVELS = (0.68, 0.95)
CONFIDENCE = 0.95
STEP = 1.04
LARGEST = 4.0


class Forecast(NamedTuple):
    """What the others say of one scene, at points drawn evenly from the prior; the truth is last.

    Attributes
    ----------
    distance
        (n + 1,) squared distance of the scene's features from those expected at each point, in
        units of their errors, correlations included.
    volume
        (n + 1,) sum of the logarithms of these errors.
    freedom
        Degrees of freedom of the scene's errors.
    """

    distance: FloatArray
    volume: FloatArray
    freedom: int


def inflation_for(forecasts: Sequence[Forecast], *, size: int) -> float:
    """Smallest factor on all errors with which the regions hold the scenes often enough.

    Of n scenes, k must lie in their region of probability P, for 0.68 and for 0.95: the smallest k
    with which a new case that resembles the scenes lies in its region with a chance of P or more,
    with a confidence of 0.95; all of them where n is too small for that. The chance that k of n
    stand for is distributed as Beta(k, n + 1 - k), whatever made the regions too small.

    Parameters
    ----------
    forecasts
        One per scene.
    size
        Number of features.

    Returns
    -------
    float
        Between 1 and 4.

    References
    ----------
    Cook, Gelman & Rubin, J. Comput. Graph. Stat. 15, 675 (2006), doi:10.1198/106186006X136976.
    Vovk, Conditional validity of inductive conformal predictors, Mach. Learn. 92, 349 (2013),
    doi:10.1007/s10994-013-5355-6, proposition 2a.
    """
    from scipy.stats import binom

    n = len(forecasts)
    needed = [min(n, 1 + int(binom.ppf(CONFIDENCE, n, level))) for level in LEVELS]
    factor = 1.0
    while factor < LARGEST:
        ranks = np.array([smallest_region(f, factor, size=size) for f in forecasts])
        held = [int((ranks <= level).sum()) for level in LEVELS]
        if all(count >= need for count, need in zip(held, needed, strict=True)):
            break
        factor *= STEP
    return min(factor, LARGEST)


def smallest_region(forecast: Forecast, factor: float, *, size: int) -> float:
    """Probability of the smallest region of highest density that holds the truth."""
    tail = np.log1p(forecast.distance / (factor**2 * forecast.freedom))
    density = -0.5 * (forecast.freedom + size) * tail - forecast.volume
    weight = np.exp(density[:-1] - density[:-1].max())
    return float(weight[density[:-1] > density[-1]].sum() / weight.sum())

"""Numbers that mean the same in a movie and in the model, free of units."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from cellquant.compare.groups import Group
from cellquant.compare.page import format_value
from cellquant.compare.results import Scalar, look_up
from cellquant.compare.units import packing_fraction_of


@dataclass(frozen=True)
class Matched:
    """A number that means the same on both sides, free of units.

    Attributes
    ----------
    key, label
        Its name.
    value, std_error
        NaN where not known.
    reason
        Why it must not be compared, or why it is not known; empty where it may be.
    rule
        How it follows from what was measured.
    interval, smoothing
        Time between frames over tau_alpha, and points of the moving average, for numbers that
        depend on them; NaN otherwise.
    unit
        Unit of a number that only one side shares; empty for a pure number.
    """

    key: str
    label: str
    value: float
    std_error: float
    rule: str
    reason: str = ""
    interval: float = math.nan
    smoothing: float = math.nan
    unit: str = ""


_DIRECT = (
    "shape_index.mean", "shape_index.median", "shape_index.mode", "shape_index.std",
    "shape_index.skewness", "van_hove.sigma2", "van_hove.xi", "msd.exponent", "alpha2_peak.value",
)  # fmt: skip


def matched_scalars(group: Group, *, area: tuple[float, float]) -> dict[str, Matched]:
    """The numbers of a group that carry no unit, or whose unit both sides share.

    Lengths are divided by the mean cell diameter d, times by tau_alpha, and the density of a
    movie becomes an effective packing fraction.
    """
    scalars = group.scalars()
    found = {
        key: Matched(key, scalars[key].label, scalars[key].value, scalars[key].std_error,
                     "as measured", _unknown(scalars[key]))
        for key in _DIRECT
        if key in scalars
    }  # fmt: skip
    found["packing_fraction"] = _packing(group, scalars, area)
    found |= _ratios(group, scalars)
    if "chi4_peak.value" in scalars:
        chi4 = scalars["chi4_peak.value"]
        reason = "χ_{4} grows with the number of cells in view, which differs between the sides"
        found["chi4_peak.value"] = Matched(
            chi4.key, chi4.label, chi4.value, chi4.std_error, "as measured", reason
        )
    for key, label, role in (
        ("tau_alpha.value", "Relaxation time τ_{α}", "time"),
        ("wave_number.mean_diameter", "Mean cell diameter d", "length"),
    ):
        if key in scalars:
            scalar = scalars[key]
            unit = scalar.unit
            found[key] = Matched(
                key, label, scalar.value, scalar.std_error, f"in {unit}",
                _unknown(scalar) or f"it sets the unit of {role} in which the sides are compared",
                unit=unit,
            )  # fmt: skip
    return found


def _unknown(scalar: Scalar) -> str:
    if math.isfinite(scalar.value):
        return ""
    return f"only a bound is known, > {format_value(scalar.censored_at)} {scalar.unit}"


def _packing(group: Group, scalars: Mapping[str, Scalar], area: tuple[float, float]) -> Matched:
    key, label = "packing_fraction", "Packing fraction φ, effective for movies"
    density = scalars.get("density.mean")
    if group.simulated:
        if "phi" in group.scene:
            return Matched(key, label, group.scene["phi"], 0.0, "φ of the scene")
        return Matched(key, label, math.nan, math.nan, "", "φ of the scene is not recorded")
    if density is None or density.unit != "1/mm^{2}":
        return Matched(key, label, math.nan, math.nan, "", "the movie has no density in 1/mm^{2}")
    error = density.std_error if math.isfinite(density.std_error) else 0.0
    value, spread = packing_fraction_of(density.value, error, area=area)
    rule = f"density × steric cell area of {area[0]:.0f} ± {area[1]:.0f} µm^{{2}}"
    reason = (
        "no one-to-one map leads from a density to a packing fraction; the effective value "
        "orders the two sides"
    )
    return Matched(key, label, value, spread, rule, reason)


def _ratios(group: Group, scalars: Mapping[str, Scalar]) -> dict[str, Matched]:
    found = {}
    d, tau = scalars.get("wave_number.mean_diameter"), scalars.get("tau_alpha.value")
    speed, lag = scalars.get("speed.mean"), scalars.get("alpha2_peak.lag_time")
    peak = scalars.get("wave_number.q_peak")
    if d is not None and peak is not None and math.isfinite(peak.value):
        found["q_peak"] = product_of(
            "q_peak", "First peak of S(q), q_{peak} d/2π", [(peak, 1), (d, 1)], 1 / (2 * math.pi)
        )
    if tau is None or not math.isfinite(tau.value):
        return found
    if lag is not None:
        found["alpha2_lag"] = product_of(
            "alpha2_lag", "Lag of the peak of α_{2}, in τ_{α}", [(lag, 1), (tau, -1)]
        )
    if speed is not None and d is not None:
        product = product_of("speed", "Mean speed, in d/τ_{α}", [(speed, 1), (tau, 1), (d, -1)])
        points = look_up(group.members[0].summary, "processing.smoothing_points")
        found["speed"] = replace(
            product,
            interval=_frame_interval(group) / tau.value,
            smoothing=math.nan if points is None else float(points),
        )
    return found


def _frame_interval(group: Group) -> float:
    speed = group.members[0].summary.get("speed", {})
    value = speed.get("dt") if isinstance(speed, Mapping) else None
    return float(value) if value is not None else math.nan


def product_of(
    key: str,
    label: str,
    terms: Sequence[tuple[Scalar, int]],
    factor: float = 1.0,
) -> Matched:
    """A product of powers of scalars, its error to first order."""
    value, squares = factor, 0.0
    for scalar, power in terms:
        value *= scalar.value**power
        squares += (power * scalar.std_error / scalar.value) ** 2
    error = abs(value) * math.sqrt(squares)
    return Matched(key, label, value, error, "ratio of measured values")

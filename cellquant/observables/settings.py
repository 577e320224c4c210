"""Options of the observables, and the check that each has a possible value."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from cellquant.errors import InputError
from cellquant.observables.windows import BIN_CENTRES, BIN_WIDTH, WINDOW_POINTS

if TYPE_CHECKING:
    from cellquant.observables.dynamics import ScatteringMethod

WaveNumber = float | Literal["2pi/d", "structure_factor_peak"]


@dataclass(frozen=True)
class Settings:
    """Options of `cellquant.observables.observe`, documented there."""

    smoothing: int | None = None
    drift: bool = True
    keep_cut_cells: bool = False
    min_points: int = WINDOW_POINTS
    window: int | None = None
    bin_width: float = BIN_WIDTH
    bin_centres: Sequence[float] = BIN_CENTRES
    wave_number: WaveNumber = "2pi/d"
    scattering: "ScatteringMethod" = "bessel"
    lags: Sequence[int] | None = None
    stride: int = 1
    overlap_cutoff: float | None = None
    van_hove_lag: float | None = None
    core_range: tuple[float, float] | None = None
    tail_range: tuple[float, float] | None = None
    max_frames: int = 32
    condition: str | None = None
    trial: str | None = None


def checked_settings(options: Mapping[str, Any]) -> Settings:
    """Settings from keyword options.

    Raises
    ------
    TypeError
        If there is no such option.
    InputError
        If an option has an impossible value.
    """
    unknown = sorted(set(options) - set(Settings.__dataclass_fields__))
    if unknown:
        raise TypeError(f"observe() has no option {unknown[0]!r}")
    settings = Settings(**options)
    rules = (
        ("smoothing", settings.smoothing is None or _odd(settings.smoothing), "odd and >= 1"),
        ("min_points", settings.min_points >= 2, ">= 2"),
        ("window", settings.window is None or settings.window >= 2, ">= 2 frames"),
        ("stride", settings.stride >= 1, ">= 1 frame"),
        ("bin_width", settings.bin_width > 0, "> 0"),
        ("max_frames", settings.max_frames >= 1, ">= 1"),
        ("scattering", settings.scattering in ("bessel", "vectors"), "'bessel' or 'vectors'"),
        ("wave_number", _is_wave_number(settings.wave_number), "> 0, '2pi/d' or "
         "'structure_factor_peak'"),
        ("overlap_cutoff", _positive(settings.overlap_cutoff), "> 0"),
        ("van_hove_lag", _positive(settings.van_hove_lag), "> 0"),
        ("core_range", _is_range(settings.core_range), "two numbers, 0 <= first < second"),
        ("tail_range", _is_range(settings.tail_range), "two numbers, 0 <= first < second"),
        ("lags", settings.lags is None or min(settings.lags, default=0) >= 1, ">= 1 frame each"),
    )  # fmt: skip
    for name, good, rule in rules:
        if not good:
            raise InputError(f"{name} must be {rule}, got {getattr(settings, name)!r}.")
    return settings


def _odd(points: int) -> bool:
    return points >= 1 and points % 2 == 1


def _positive(value: float | None) -> bool:
    return value is None or (value > 0 and bool(np.isfinite(value)))


def _is_range(value: tuple[float, float] | None) -> bool:
    return value is None or (len(value) == 2 and 0 <= value[0] < value[1])


def _is_wave_number(value: Any) -> bool:
    if isinstance(value, str):
        return value in ("2pi/d", "structure_factor_peak")
    return isinstance(value, (int, float)) and _positive(float(value))

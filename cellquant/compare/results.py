"""What `observe` found, as curves to draw and as scalars to list: one reading for every report."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cellquant.compare.figures import Curve
from cellquant.errors import InputError
from cellquant.tables import Units, read_table

if TYPE_CHECKING:
    import pandas as pd

    from cellquant.io import LabelStack
    from cellquant.observables import Observables
    from cellquant.sim import Run
    from cellquant.tables import Tracks

FloatArray = np.ndarray[Any, np.dtype[np.float64]]


@dataclass(frozen=True)
class Scalar:
    """One number of a result.

    Attributes
    ----------
    key
        Its place in the summary, e.g. ``shape_index.mean``.
    label
        Name and symbol.
    value, std_error
        NaN where not known.
    unit
        Unit as written on the page; empty for a pure number.
    n
        Size of the sample behind it, in words.
    rule
        How it was obtained.
    power
        Exponents of length and time in its unit, by which it is converted.
    censored_at
        The value is larger than this, and not known; NaN otherwise.
    """

    key: str
    label: str
    value: float
    std_error: float
    unit: str
    n: str
    rule: str
    power: tuple[int, int] = (0, 0)
    censored_at: float = math.nan


@dataclass(frozen=True)
class _Entry:
    """Where the summary keeps a scalar, and what it means."""

    key: str
    label: str
    power: tuple[int, int]
    rule: str
    error_key: str = ""
    n_key: str = ""


_CATALOGUE = (
    _Entry("density.mean", "Number density", (-2, 0), "cells per area that cells can occupy, "
           "averaged over frames", "density.std_error"),
    _Entry("shape_index.mean", "Mean shape index ⟨p⟩", (0, 0),
           "p = P/√A of every cell away from the border, all frames pooled",
           "shape_index.std_error", "shape_index.n"),
    _Entry("shape_index.median", "Median shape index", (0, 0), "of the same cells",
           "shape_index.median_std_error", "shape_index.n"),
    _Entry("shape_index.mode", "Most frequent shape index", (0, 0), "maximum of the smoothed P(p)",
           "shape_index.mode_std_error", "shape_index.n"),
    _Entry("shape_index.std", "Width of P(p)", (0, 0), "standard deviation of p",
           "shape_index.std_std_error", "shape_index.n"),
    _Entry("shape_index.skewness", "Skewness of P(p)", (0, 0), "third standardised moment of p",
           "shape_index.skewness_std_error", "shape_index.n"),
    _Entry("wave_number.mean_diameter", "Mean cell diameter d", (1, 0),
           "d = ⟨√(4A/π)⟩", "wave_number.mean_diameter_std_error"),
    _Entry("wave_number.q", "Wave number q", (-1, 0), "", "wave_number.q_std_error"),
    _Entry("wave_number.q_peak", "First peak of the structure factor", (-1, 0),
           "first maximum of S(q), a check of q", "wave_number.q_peak_std_error"),
    _Entry("tau_alpha.value", "Relaxation time τ_{α}", (0, 1), "F_{s}(q, τ_{α}) = 1/e",
           "tau_alpha.std_error"),
    _Entry("speed.mean", "Mean speed", (1, -1), "displacement between consecutive frames over "
           "their time", "speed.std_error"),
    _Entry("speed.median", "Median speed", (1, -1), "of the same displacements",
           "speed.median_std_error"),
    _Entry("van_hove.sigma2", "Core of G_{s}: σ^{2}/d^{2}", (0, 0),
           "core of the van Hove function at t = τ_{α} fitted by exp(−r^{2}/σ^{2}), σ^{2} being "
           "its mean square displacement", "van_hove.sigma2_std_error"),
    _Entry("van_hove.xi", "Tail of G_{s}: ξ/d", (0, 0),
           "tail of the van Hove function at t = τ_{α} fitted by exp(−r/ξ)",
           "van_hove.xi_std_error"),
    _Entry("msd.exponent", "Exponent of the MSD", (0, 0), "slope in the logarithms at long lags",
           "msd.exponent_std_error"),
    _Entry("msd.diffusion_coefficient", "Diffusion coefficient D", (2, -1),
           "MSD/(4t) at a third of the longest lag", "msd.diffusion_coefficient_std_error"),
    _Entry("alpha2_peak.value", "Peak of α_{2}", (0, 0), "largest non-Gaussian parameter",
           "alpha2_peak.std_error"),
    _Entry("alpha2_peak.lag_time", "Lag of the peak of α_{2}", (0, 1), "lag of that peak"),
    _Entry("chi4_peak.value", "Peak of χ_{4}", (0, 0), "largest four-point susceptibility",
           "chi4_peak.std_error"),
    _Entry("chi4_peak.lag_time", "Lag of the peak of χ_{4}", (0, 1), "lag of that peak"),
)  # fmt: skip


@dataclass(frozen=True)
class Result:
    """Observables of one movie, study or simulation, with a name.

    Attributes
    ----------
    name
        How it is called on the page.
    summary
        As in ``summary.json``.
    tables
        Tables by name of the observable.
    record
        How it was made: the content of ``run.json``; empty when not known.
    folder
        Where it was read from; None for results in memory.
    tracks
        Trajectories, for the pictures; None where they are not at hand.
    stack
        Label masks of the movie, or None.
    run
        The simulated run, or None.
    """

    name: str
    summary: Mapping[str, Any]
    tables: Mapping[str, "pd.DataFrame"]
    record: Mapping[str, Any]
    folder: Path | None = None
    tracks: "Tracks | None" = None
    stack: "LabelStack | None" = None
    run: "Run | None" = None

    @property
    def units(self) -> Units:
        """Unit names of summary and tables."""
        return Units(str(self.summary["length_unit"]), str(self.summary["time_unit"]))

    @property
    def simulated(self) -> bool:
        """Whether it is in the reduced units of the model."""
        return self.units.length == "L0"


def read_result(source: "str | Path | Observables | Result", *, name: str = "") -> Result:
    """Take observables in memory, or read the folder that `observe` wrote.

    Parameters
    ----------
    source
        Observables, or a folder with ``summary.json`` and one parquet table per observable.
    name
        Its name on the page; the folder's name when empty.

    Raises
    ------
    InputError
        If the folder is missing, or its summary or a table cannot be read.
    """
    if isinstance(source, Result):
        return source
    if not isinstance(source, str | Path):
        reduced = source.summary.get("length_unit") == "L0"
        label = name or ("simulation" if reduced else "experiment")
        return Result(label, source.summary, source.tables, {})
    folder = Path(source)
    path = folder / "summary.json"
    if not path.is_file():
        raise InputError(
            f"{folder} holds no summary.json; give a folder that 'cellquant observe SOURCE -o DIR' "
            "has written."
        )
    try:
        summary = json.loads(path.read_text(encoding="utf-8"))
        record_path = folder / "run.json"
        record = json.loads(record_path.read_text("utf-8")) if record_path.is_file() else {}
        Units(summary["length_unit"], summary["time_unit"])
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise InputError(
            f"{path} is not a summary of observables ({error}); make it again with "
            "'cellquant observe SOURCE -o DIR'."
        ) from error
    tables = {
        file.stem: read_table(file)[0]
        for file in sorted(folder.glob("*.parquet"))
        if file.stem not in {"tracks", "cells"}
    }
    return Result(name or folder.resolve().name, summary, tables, record, folder)


def meanings() -> dict[str, tuple[str, str]]:
    """Label of every scalar, and how it is obtained, by key."""
    return {entry.key: (entry.label, entry.rule or "2π/d, unless given") for entry in _CATALOGUE}


def look_up(summary: Mapping[str, Any], key: str) -> Any:
    """Value at a dotted place of a summary; None where there is none."""
    found: Any = summary
    for part in key.split("."):
        if not isinstance(found, Mapping) or part not in found:
            return None
        found = found[part]
    return found


def read_scalars(result: Result) -> list[Scalar]:
    """Every scalar of the catalogue that the summary holds, in the order of the page."""
    scalars = []
    for entry in _CATALOGUE:
        value = _number(look_up(result.summary, entry.key))
        group = look_up(result.summary, entry.key.split(".")[0])
        censored = math.nan
        if entry.key == "tau_alpha.value":
            censored = _number(look_up(result.summary, "tau_alpha.censored_at"))
        if not math.isfinite(value) and not math.isfinite(censored):
            continue
        count = look_up(result.summary, entry.n_key) if entry.n_key else None
        factor, unit = scale_of(entry.power, result.units)
        error = _number(look_up(result.summary, entry.error_key))
        scalars.append(
            Scalar(
                key=entry.key,
                label=entry.label,
                value=factor * value,
                std_error=factor * error,
                unit=unit,
                n=_sample(entry.key, count, result.summary),
                rule=_rule(entry, group, known_error=math.isfinite(error)),
                power=entry.power,
                censored_at=censored,
            )
        )
    return scalars


def reasons(result: Result) -> list[str]:
    """Why something could not be measured, as the summary says it, one sentence each."""
    found = []
    for name, group in result.summary.items():
        if isinstance(group, Mapping) and isinstance(group.get("reason"), str):
            found.append(f"{name.replace('_', ' ').capitalize()}: {group['reason']}.")
    return found


def scale_of(power: tuple[int, int], units: Units) -> tuple[float, str]:
    """Factor and unit in which a quantity is shown: number densities per mm^2, not per um^2."""
    if power == (-2, 0) and units.length == "um":
        return 1e6, "1/mm^{2}"
    if power == (-2, 0) and units.length == "px":
        return 1e6, "per million px^{2}"
    return 1.0, unit_text(power, units)


def unit_text(power: tuple[int, int], units: Units) -> str:
    """A unit such as ``µm/min`` or ``1/µm^{2}`` from exponents of length and time."""
    names = (pretty_unit(units.length), pretty_unit(units.time))
    above = [_raised(n, p) for n, p in zip(names, power, strict=True) if p > 0]
    below = [_raised(n, -p) for n, p in zip(names, power, strict=True) if p < 0]
    if not below:
        return " ".join(above)
    return f"{' '.join(above) or '1'}/{' '.join(below)}"


def pretty_unit(unit: str) -> str:
    """Spelling of a unit on the page."""
    return {"um": "µm", "L0": "L_{0}", "t0": "t_{0}"}.get(unit, unit)


def plain_unit(unit: str) -> str:
    """Spelling of a unit in files: without markup, ``1`` for a pure number."""
    return unit.replace("_{", "").replace("{", "").replace("}", "") or "1"


def _raised(name: str, power: int) -> str:
    return name if power == 1 else f"{name}^{{{power}}}"


def _number(value: Any) -> float:
    return float(value) if isinstance(value, int | float) and value is not None else math.nan


def _sample(key: str, count: Any, summary: Mapping[str, Any]) -> str:
    if isinstance(count, int):
        return f"{count} contours"
    group = key.split(".")[0]
    frames = f"{summary.get('n_frames')} frames"
    if group in {"density", "wave_number"}:
        return frames
    retained = look_up(summary, "processing.n_tracks_retained") or summary.get("n_tracks")
    return f"{retained} tracks" if retained else frames


def _rule(entry: _Entry, group: Any, *, known_error: bool) -> str:
    if entry.key == "wave_number.q" and isinstance(group, Mapping):
        rules = {
            "2pi/d": "q = 2π/d",
            "structure_factor_peak": "first peak of the structure factor",
            "given": "given by the user",
        }
        return rules.get(str(group.get("rule")), str(group.get("rule")))
    text = entry.rule
    method = group.get("std_error_method") if isinstance(group, Mapping) else None
    if isinstance(method, str) and known_error:
        text += f"; error: {method}"
    note = group.get("note") if isinstance(group, Mapping) else None
    return f"{text}; {note}" if isinstance(note, str) else text


def curve_of(
    result: Result,
    table: str,
    *,
    x: str = "lag_time",
    series: int = 0,
    kind: str = "line",
    label: str | None = None,
) -> Curve | None:
    """The whole-recording rows of a table as a curve; None where it was not measured.

    Parameters
    ----------
    result
        Where to look.
    table
        Name of the observable; its table has columns `x`, value, std_error.
    x
        Column of the abscissa.
    """
    data = result.tables.get(table)
    if data is None or data.empty or x not in data.columns or "value" not in data.columns:
        return None
    if "scope" in data.columns:
        data = data[data["scope"] == "all"]
    error = data["std_error"].to_numpy(np.float64) if "std_error" in data.columns else None
    return Curve(
        label=result.name if label is None else label,
        x=data[x].to_numpy(np.float64),
        y=data["value"].to_numpy(np.float64),
        error=error,
        series=series,
        kind=kind,
    )

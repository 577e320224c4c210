"""Results in words: the lines that commands print."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cellquant.io import LabelStack
    from cellquant.sim import Run
    from cellquant.tables import Cells, Tracks


def with_error(value: float | None, std_error: float | None, unit: str = "") -> str:
    """Write a value with as many digits as its standard error allows, e.g. ``3.912 ± 0.014``.

    Values without an error carry four significant digits.
    """
    from math import floor, isfinite, log10

    suffix = f" {unit}" if unit else ""
    if value is None or not isfinite(value):
        return "not measurable"
    # An error at the level of round-off is none.
    if not std_error or not isfinite(std_error) or std_error <= 1e-12 * abs(value):
        return f"{value:.4g}{suffix}"
    digits = max(0, 1 - floor(log10(abs(std_error))))
    return f"{value:.{digits}f} ± {std_error:.{digits}f}{suffix}"


def track_lines(masks: "LabelStack", cells: "Cells", tracks: "Tracks") -> list[str]:
    """What tracking found, and what it chose."""
    calibration = masks.calibration
    units = calibration.units
    per_frame = cells.table.groupby("frame").size()
    lines = [
        f"frames: {masks.n_frames} of {masks.shape[1]} x {masks.shape[0]} px",
        f"calibration: {calibration.pixel_size:g} {units.length} per px, "
        f"{calibration.frame_interval:g} {units.time} per frame ({calibration.source})",
        f"cells: {len(cells.table)} in all, {per_frame.min()} to {per_frame.max()} per frame",
    ]
    faults = {name: count for name, count in cells.faults.items() if count}
    if faults:
        found = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in faults.items())
        lines.append(f"faults handled: {found}")
    lines += [f"note: {text}" for text in masks.notes]
    lines.append(f"tracks: {tracks.n_tracks}")
    lines += _provenance_lines(tracks.provenance, units.length)
    return lines


def _provenance_lines(provenance: Mapping[str, Any], length_unit: str) -> list[str]:
    lines = []
    for name in ("divisions", "gaps_closed"):
        if name in provenance:
            lines.append(f"{name.replace('_', ' ')}: {provenance[name]}")
    if "search_range" in provenance:
        lines.append(f"search range: {provenance['search_range']:.4g} {length_unit}")
    lines += [f"warning: {text}" for text in provenance.get("warnings", [])]
    return lines


def summary_lines(summary: Mapping[str, Any]) -> list[str]:
    """The scalar results of `observe`, each with unit and standard error."""
    length, time = summary["length_unit"], summary["time_unit"]
    lines = []

    def missing(group: Mapping[str, Any]) -> str:
        return f"not measurable ({group.get('reason', 'no reason given')})"

    shape = summary.get("shape_index")
    if shape:
        lines.append(
            f"shape index: mean {with_error(shape['mean'], shape['std_error'])}, "
            f"median {with_error(shape['median'], None)}, n = {shape['n']} contours"
        )
    density = summary.get("density")
    if density:
        unit = f"cells/{length}^2"
        mean, error = density["mean"], density["std_error"]
        if length == "um" and mean is not None:
            unit, mean = "cells/mm^2", mean * 1e6
            error = None if error is None else error * 1e6
        lines.append(f"density: {with_error(mean, error, unit)}")
    wave = summary.get("wave_number")
    if wave and wave["q"] is not None:
        lines.append(f"wave number: {wave['q']:.4g} 1/{length} ({wave['rule']})")
    tau = summary.get("tau_alpha")
    if tau:
        if tau["value"] is None and tau["censored_at"] is not None:
            lines.append(f"tau_alpha: > {tau['censored_at']:g} {time} (1/e not reached)")
        elif tau["value"] is None:
            lines.append(f"tau_alpha: {missing(tau)}")
        else:
            lines.append(f"tau_alpha: {with_error(tau['value'], tau['std_error'], time)}")
    speed = summary.get("speed")
    if speed and speed["mean"] is None:
        lines.append(f"speed: {missing(speed)}")
    elif speed:
        lines.append(
            f"speed: mean {with_error(speed['mean'], speed.get('std_error'))} {length}/{time} "
            f"over {speed['dt']:g} {time}"
        )
    return lines


def run_lines(run: "Run") -> list[str]:
    """What a simulated run is, what it cost, and whether it may be averaged."""
    from cellquant.errors import InputError

    scene, settings, work = run.scene, run.settings, run.work
    pace = (
        f"step {settings['dt']:g} t0"
        if settings["tolerance"] is None
        else f"tolerance {settings['tolerance']:g} L0"
    )
    contacts = "exact contacts"
    if settings["contact"] != "exact":
        contacts = f"contacts by {settings['points']} points"
    lines = [
        f"scene: {scene.n_cells} cells, phi {run.phi:.4g}, v0 {scene.v0:g}, eta {scene.eta:g}",
        f"box: {run.box[0]:.4f} x {run.box[1]:.4f} L0",
        f"scheme: {settings['integrator']}, {pace}, {contacts}",
        f"saved: {run.n_frames} states, one every {settings['save_every']:g} t0, "
        f"after {settings['transient']:g} t0",
    ]
    simulated = settings["transient"] + (run.n_frames - 1) * settings["save_every"]
    if work.get("cpu_seconds"):
        lines.append(f"speed: {simulated / work['cpu_seconds']:.3g} t0 per second of CPU time")
    shown = {k: v for k, v in sorted(work.items()) if not k.startswith(("pinched", "repaired"))}
    lines += [f"{name.replace('_', ' ')}: {value:.6g}" for name, value in shown.items()]
    if work.get("repaired"):
        lines.append(f"repaired: {work['repaired']} steps that failed were taken in parts")
    if work.get("pinched_cells"):
        lines.append(
            f"pinched: {work['pinched_cells']} cells reached R <= 0 at their waist, "
            f"{100 * work['pinched_share']:.2g} % of all cells and times"
        )
    try:
        found = run.stationarity()
    except InputError as error:
        return [*lines, f"stationarity: not tested ({error})"]
    verdict = "no drift seen" if found.stationary else "NOT STATIONARY, do not average"
    drift = with_error(found.drift, found.std_error)
    return [*lines, f"stationarity: {verdict} (<p> changed by {drift} between the halves)"]

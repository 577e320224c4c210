"""The closed loop: simulate, render to masks, run the experiment pipeline, compare with the truth.

Between the simulation and what the pipeline reports lie four steps, each of which may add an error.
They are told apart by observing the same layer after each of them, so that most of the sampling
noise is common to all: the run itself; the run at the frame interval of the camera; its true tracks
as far as the camera sees them; the cells measured on the masks, with their true identities; and the
tracks that were found.

A field of view loses the cells that leave it, the fast ones first, and with them motion. So the
camera sees one period of the layer with a guard strip around it, and the cells that start in that
period are followed: every cell of the layer once, chosen before anything is known of its motion,
and lost only when it crosses the strip.

Movies are smoothed by default, over five points. That changes what is measured, truth included, so
it is held apart: the tracks that were found and the run at the frame interval of the camera are
observed once more, both smoothed.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cellquant.pipeline import Step, observe_into, silent, simulate_scene, track_movie
from cellquant.storage import RunRecord, write_json

if TYPE_CHECKING:
    import pandas as pd

    from cellquant.config import SceneConfig
    from cellquant.observables import Observables
    from cellquant.sim import Run
    from cellquant.tables import Cells, Tracks

LENGTH = 23.9  # um in one L0: a disc of 450 um^2
TIME = 2.0  # min in one t0
PIXEL = LENGTH / 30.0  # um: cells of 15 pixels radius
GUARD = 4.0  # L0 that the camera sees of the periodic layer beyond each edge of one period
FINER = 5  # frames of the run in one frame interval of the camera

STAGES = {
    "truth": "the run itself",
    "sampled": "the run at the frame interval of the camera",
    "field": "its true tracks as far as the camera sees them",
    "pixels": "cells measured on the masks, true identities",
    "found": "tracks found",
}
SMOOTHED = {
    "truth_smoothed": "the run at the frame interval of the camera, smoothed over five points",
    "found_smoothed": "tracks found, smoothed over five points",
}
SMOOTHING = 5  # points, the default for movies
# What the step from one stage to the next adds.
STEPS = {
    "sampled": "frame interval",
    "field": "finite window",
    "pixels": "pixels",
    "found": "linking",
}
WANTED = (
    "shape_index",
    "wave_number",
    "speed",
    "msd",
    "self_intermediate_scattering",
    "tau_alpha",
    "van_hove",
)


@dataclass(frozen=True)
class Quantity:
    """A number that every stage measures.

    Attributes
    ----------
    label
        Its name in the table.
    unit
        Its unit, in L0 and t0.
    group, part, error
        Its place in ``summary.json``, and that of its standard error.
    length, time
        Exponents of length and time in its unit.
    sampled
        Whether it is defined by the frame interval, so that its truth is that of the sampled run.
    """

    label: str
    unit: str
    group: str
    part: str
    error: str = "std_error"
    length: int = 0
    time: int = 0
    sampled: bool = False


MSD = Quantity("MSD at the relaxation time", "L0^2", "msd", "at_tau", "at_tau_std_error", length=2)
QUANTITIES = (
    Quantity("mean shape index", "1", "shape_index", "mean"),
    Quantity(
        "mean diameter", "L0", "wave_number", "mean_diameter", "mean_diameter_std_error", length=1
    ),
    Quantity("mean speed", "L0/t0", "speed", "mean", length=1, time=-1, sampled=True),
    MSD,
    Quantity("relaxation time", "t0", "tau_alpha", "value", time=1),
    Quantity(
        "van Hove core \N{GREEK SMALL LETTER SIGMA}²",
        "d^2",
        "van_hove",
        "sigma2",
        "sigma2_std_error",
    ),
    Quantity("van Hove tail \N{GREEK SMALL LETTER XI}", "d", "van_hove", "xi", "xi_std_error"),
)


@dataclass(frozen=True)
class Loop:
    """Everything a closed loop made.

    Attributes
    ----------
    run
        The simulated run.
    observed
        Observables of every stage, by its name in `STAGES` and `SMOOTHED`.
    tracks
        The tracks found of the cells that are followed.
    record
        How they were found.
    table
        One row per quantity, see `closed_loop_table`.
    settings
        Scene, camera and smoothing.
    """

    run: "Run"
    observed: "Mapping[str, Observables]"
    tracks: "Tracks"
    record: RunRecord
    table: "pd.DataFrame"
    settings: Mapping[str, Any]


def close_loop(scene: "SceneConfig", folder: Path, *, step: Step = silent) -> Loop:
    """Simulate a scene, render it, measure the masks, and hold the result against the truth.

    Parameters
    ----------
    scene
        The scene and its run; the camera takes a frame every ``save_every``, and the run is saved
        five times as often.
    folder
        Output folder: ``run.zarr``, ``masks.tif`` with ``masks_truth``, ``tracked`` with all cells
        and tracks of the masks, a folder of observables for each of `STAGES` and `SMOOTHED` (that
        of ``found`` holds the tracks that are followed), and ``closed_loop.json``.
    step
        Gives a progress callback for each stage.
    """
    from cellquant.io import read_labels
    from cellquant.observables import columns_read
    from cellquant.sim import render

    interval = scene.save_every or 1.0
    finer = scene.model_copy(update={"save_every": interval / FINER})
    run = simulate_scene(finer, folder / "run.zarr", step=step)
    with step("render") as progress:
        rendering = render(
            run,
            folder / "masks.tif",
            pixel_size=PIXEL,
            length=LENGTH,
            time=TIME,
            margin=2.0 * GUARD,
            step=FINER,
            progress=progress,
        )
    masks = read_labels(folder / "masks.tif")
    cells, tracks, record = track_movie(masks, folder / "tracked", step=step)
    truth = run.to_tracks(columns=columns_read(WANTED))
    sampled = _every(truth, FINER)
    seen = _followed(rendering.tracks, run)
    identified = _followed(_with_identities(cells, rendering.tracks), run)
    found = _followed(tracks, run)
    (folder / "found").mkdir(parents=True, exist_ok=True)
    found.write(folder / "found" / "tracks.parquet")
    observed = {}
    for name, origin, source, points in (
        ("truth", "../run.zarr", truth, 1),
        ("sampled", "../run.zarr", sampled, 1),
        ("field", "../masks_truth", seen, 1),
        ("pixels", "../tracked/cells.parquet", identified, 1),
        ("found", "../masks.tif", found, 1),
        ("truth_smoothed", "../run.zarr", sampled, SMOOTHING),
        ("found_smoothed", "../found/tracks.parquet", found, SMOOTHING),
    ):
        settings = {
            "source": origin,
            "stage": (STAGES | SMOOTHED)[name],
            "smoothing": points,
            "only": list(WANTED),
        }
        made = record if name == "found" else RunRecord("observe", settings)
        options = {"smoothing": points, "only": list(WANTED)}
        observed[name] = observe_into(source, folder / name, made, options=options, step=step)
        made.write(folder / name)
    table = closed_loop_table({name: _values(o) for name, o in _with_msd(observed).items()})
    known = table.astype(object).where(table.notna(), None)
    write_json(folder / "closed_loop.json", known.to_dict("records"))
    made_with = {
        **finer.model_dump(),
        "um per L0": LENGTH,
        "min per t0": TIME,
        "um per pixel": PIXEL,
        "guard strip around the layer, L0": GUARD,
        "frames of the run per frame of the camera": FINER,
        "points of the smoothing, where smoothed": SMOOTHING,
    }
    return Loop(run, observed, found, record, table, made_with)


def _every(tracks: "Tracks", step: int) -> "Tracks":
    """Every step-th frame of the tracks."""
    kept = tracks.table[tracks.table["frame"] % step == 0]
    table = kept.assign(frame=kept["frame"] // step).reset_index(drop=True)
    return replace(tracks, table=table, frame_interval=tracks.frame_interval * step)


def _followed(tracks: "Tracks", run: "Run") -> "Tracks":
    """The tracks, in um, that start inside the guard strip: each cell of the layer once."""
    strip = GUARD * LENGTH
    width, height = (edge * LENGTH for edge in run.box)
    first = tracks.table[tracks.table["frame"] == 0]
    inside = first["x"].between(strip, strip + width, inclusive="left")
    inside &= first["y"].between(strip, strip + height, inclusive="left")
    kept = tracks.table["track_id"].isin(first["track_id"][inside])
    table = tracks.table[kept].reset_index(drop=True)
    return replace(tracks, table=table, area=width * height)


def _with_identities(cells: "Cells", truth: "Tracks") -> "Tracks":
    """The measured cells, linked as the truth says."""
    known = truth.table[["frame", "label", "track_id", "parent_track_id", "time"]]
    from cellquant.tables import TRACK_COLUMNS

    table = known.merge(cells.table, on=["frame", "label"])
    table = table.sort_values(["track_id", "frame"], ignore_index=True)
    return replace(truth, table=table[list(TRACK_COLUMNS)])


def _with_msd(observed: "Mapping[str, Observables]") -> "dict[str, Observables]":
    """Add the MSD at the true relaxation time to the summaries, interpolated between lags."""
    import numpy as np

    tau = observed["truth"].summary["tau_alpha"]["value"]
    extended = {}
    for name, one in observed.items():
        table = one.tables["msd"]
        lag = table["lag_time"].to_numpy()
        found: dict[str, float | None] = {"at_tau": None, "at_tau_std_error": None}
        time = None if tau is None else tau * (1.0 if one.units.time == "t0" else TIME)
        if time is not None and lag.size and lag[0] <= time <= lag[-1]:
            value = np.exp(np.interp(np.log(time), np.log(lag), np.log(table["value"])))
            error = np.interp(time, lag, table["std_error"])
            found = {"at_tau": float(value), "at_tau_std_error": float(error)}
        extended[name] = replace(one, summary={**one.summary, "msd": found})
    return extended


def _values(observed: "Observables") -> "dict[str, tuple[float, float]]":
    """Value and standard error of every quantity in reduced units; NaN where not measured."""
    reduced = observed.units.time == "t0"
    values = {}
    for quantity in QUANTITIES:
        group = observed.summary.get(quantity.group) or {}
        scale = 1.0 if reduced else LENGTH**quantity.length * TIME**quantity.time
        value, error = (group.get(name) for name in (quantity.part, quantity.error))
        values[quantity.label] = (
            float("nan") if value is None else value / scale,
            float("nan") if error is None else error / scale,
        )
    return values


def closed_loop_table(stages: "Mapping[str, Mapping[str, tuple[float, float]]]") -> "pd.DataFrame":
    """Truth, measurement and error of every quantity, and what each step adds to the error.

    Parameters
    ----------
    stages
        By the name of the stage (`STAGES` and `SMOOTHED`), for each quantity its value and
        standard error in units of the model.

    Returns
    -------
    pandas.DataFrame
        quantity, unit, truth, truth_std_error, measured, measured_std_error, error
        (measured/truth - 1), error_in_std_errors (of the measured value), then for each step its
        share: this stage over the one before, minus 1. The speed is defined by the frame
        interval: its truth is the sampled run's. Then truth and measurement with both smoothed,
        ``smoothing_adds``: what smoothing changes in the tracks found, not part of the error, and
        ``error_smoothed``: the error with both smoothed. NaN where a quantity could not be
        measured.
    """
    import pandas as pd

    names = list(STAGES)
    rows = []
    for quantity in QUANTITIES:
        label = quantity.label
        values = {name: stages[name][label][0] for name in names}
        origin = "sampled" if quantity.sampled else "truth"
        values["truth"] = values[origin]
        measured, measured_error = stages["found"][label]
        row: dict[str, Any] = {
            "quantity": label,
            "unit": quantity.unit,
            "truth": values["truth"],
            "truth_std_error": stages[origin][label][1],
            "measured": measured,
            "measured_std_error": measured_error,
            "error": measured / values["truth"] - 1.0,
            "error_in_std_errors": (measured - values["truth"]) / measured_error,
        }
        for before, after in pairwise(names):
            row[f"from_{STEPS[after].replace(' ', '_')}"] = values[after] / values[before] - 1.0
        for name, column in (("truth_smoothed",) * 2, ("found_smoothed", "measured_smoothed")):
            row[column], row[f"{column}_std_error"] = stages[name][label]
        row["smoothing_adds"] = row["measured_smoothed"] / measured - 1.0
        row["error_smoothed"] = row["measured_smoothed"] / row["truth_smoothed"] - 1.0
        rows.append(row)
    return pd.DataFrame(rows)

"""The closed loop: simulate, render to masks, run the experiment pipeline, compare with the truth.

Between the simulation and what the pipeline reports lie four steps, each of which may add an error;
they are told apart by observing at every stage: the run itself (true contours, unwrapped paths in
the periodic box), the true tracks in the field of view (borders, frame interval, pixels of the
contours), and the tracks that were found in the masks (linking).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cellquant.pipeline import Step, observe_into, silent, simulate_scene, track_movie
from cellquant.storage import RunRecord, write_json

if TYPE_CHECKING:
    import pandas as pd

    from cellquant.config import SceneConfig
    from cellquant.observables import Observables
    from cellquant.sim import Run
    from cellquant.tables import Tracks

LENGTH = 23.9  # um in one L0: a disc of 450 um^2
TIME = 2.0  # min in one t0
PIXEL = LENGTH / 30.0  # um: cells of 15 pixels radius

# Name in the table, place in the summary, exponents of length and time in its unit.
QUANTITIES = (
    ("mean shape index", "shape_index", "mean", (0, 0)),
    ("mean diameter", "wave_number", "mean_diameter", (1, 0)),
    ("relaxation time", "tau_alpha", "value", (0, 1)),
    ("mean speed", "speed", "mean", (1, -1)),
)


@dataclass(frozen=True)
class Loop:
    """Everything a closed loop made.

    Attributes
    ----------
    run
        The simulated run.
    truth, field, found
        Observables of the run, of the true tracks in the field of view, and of the tracks found
        in the masks. All with the same smoothing and window.
    tracks
        The tracks found.
    record
        How they were found.
    table
        One row per quantity: truth, in_field, measured, their standard errors, and the errors.
    """

    run: "Run"
    truth: "Observables"
    field: "Observables"
    found: "Observables"
    tracks: "Tracks"
    record: RunRecord
    table: "pd.DataFrame"


def close_loop(scene: "SceneConfig", folder: Path, *, step: Step = silent) -> Loop:
    """Simulate a scene, render it, measure the masks, and hold the result against the truth.

    Parameters
    ----------
    scene
        The scene and its run; frames are one every ``save_every``.
    folder
        Output folder: ``run.zarr``, ``masks.tif`` with ``masks_truth``, the folders ``truth``,
        ``field`` and ``found`` of observables, and ``closed_loop.json``.
    step
        Gives a progress callback for each stage.
    """
    from cellquant.io import read_labels
    from cellquant.sim import render

    run = simulate_scene(scene, folder / "run.zarr", step=step)
    with step("render") as progress:
        rendering = render(
            run,
            folder / "masks.tif",
            pixel_size=PIXEL,
            length=LENGTH,
            time=TIME,
            progress=progress,
        )
    masks = read_labels(folder / "masks.tif")
    _, tracks, record = track_movie(masks, folder / "found", step=step)
    observed = {}
    for name, source in (
        ("truth", run.to_tracks()),
        ("field", rendering.tracks),
        ("found", tracks),
    ):
        made = record if name == "found" else RunRecord("observe", {"source": name})
        # No smoothing: the simulation has no localisation noise, and the paths are compared.
        observed[name] = observe_into(
            source, folder / name, made, options={"smoothing": 1}, step=step
        )
        made.write(folder / name)
    table = closed_loop_table({name: o.summary for name, o in observed.items()})
    known = table.astype(object).where(table.notna(), None)
    write_json(folder / "closed_loop.json", known.to_dict("records"))
    return Loop(run, observed["truth"], observed["field"], observed["found"], tracks, record, table)


def closed_loop_table(summaries: Mapping[str, Mapping[str, Any]]) -> "pd.DataFrame":
    """Truth, measurement and error of every quantity, in reduced units.

    Parameters
    ----------
    summaries
        Of the run (``truth``, in L0 and t0), the true tracks in the field (``field``) and the
        tracks found (``found``), both in um and min.

    Returns
    -------
    pandas.DataFrame
        quantity, unit, truth, truth_std_error, in_field, measured, measured_std_error, error
        (measured/truth - 1), from_field (in_field/truth - 1: borders, frame interval and finite
        window) and from_masks (measured/in_field - 1: pixels and linking). NaN where a quantity
        could not be measured.
    """
    import pandas as pd

    rows = []
    for label, group, part, (length, time) in QUANTITIES:
        scale = LENGTH**length * TIME**time
        truth = _number(summaries["truth"], group, part)
        inside = _number(summaries["field"], group, part) / scale
        found = _number(summaries["found"], group, part) / scale
        error = "mean_diameter_std_error" if part == "mean_diameter" else "std_error"
        rows.append(
            {
                "quantity": label,
                "unit": {(0, 0): "1", (1, 0): "L0", (0, 1): "t0", (1, -1): "L0/t0"}[length, time],
                "truth": truth,
                "truth_std_error": _number(summaries["truth"], group, error),
                "in_field": inside,
                "measured": found,
                "measured_std_error": _number(summaries["found"], group, error) / scale,
                "error": found / truth - 1.0,
                "from_field": inside / truth - 1.0,
                "from_masks": found / inside - 1.0,
            }
        )
    return pd.DataFrame(rows)


def _number(summary: Mapping[str, Any], group: str, part: str) -> float:
    value = (summary.get(group) or {}).get(part)
    return float("nan") if value is None else float(value)

"""Commands of the experiment side: inspect, segment, track, evaluate, observe, export."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from cellquant.cli.console import Progress, ProgressOption, note, say, say_json, step
from cellquant.errors import InputError

PixelSize = Annotated[
    float | None,
    typer.Option(help="Edge of a pixel in um; overrides what the file says.", metavar="UM"),
]
FrameInterval = Annotated[
    float | None,
    typer.Option(help="Time between frames in min; overrides what the file says.", metavar="MIN"),
]


class UnitChoice(StrEnum):
    physical = "physical"
    pixel = "pixel"


UnitsOption = Annotated[
    UnitChoice, typer.Option(help="'pixel' allows results in pixels and frames.")
]
Output = Annotated[Path, typer.Option("-o", "--output", help="Output folder.")]


class Backend(StrEnum):
    watershed = "watershed"
    micro_sam = "micro-sam"


class Modality(StrEnum):
    auto = "auto"
    phase_contrast = "phase_contrast"
    fluorescence = "fluorescence"


class Linker(StrEnum):
    cues = "cues"
    trackpy = "trackpy"


class TrackFormat(StrEnum):
    ctc = "ctc"
    trackmate = "trackmate"
    napari = "napari"
    geff = "geff"
    csv = "csv"


def _calibration(
    pixel_size: float | None, frame_interval: float | None, units: UnitChoice
) -> dict[str, Any]:
    return {
        "pixel_size": pixel_size,
        "frame_interval": frame_interval,
        "units": "pixel" if units is UnitChoice.pixel else None,
    }


def inspect(
    path: Annotated[Path, typer.Argument(help="A TIFF stack, a folder of frames, a CTC folder.")],
    json: Annotated[bool, typer.Option("--json", help="Print JSON for programs.")] = False,
    pixel_size: PixelSize = None,
    frame_interval: FrameInterval = None,
    units: UnitsOption = UnitChoice.physical,
) -> None:
    """Tell what is in a stack of label masks: axes, frames, calibration, IDs, cells, faults."""
    from cellquant.io import inspect_labels, read_labels

    masks = read_labels(path, **_calibration(pixel_size, frame_interval, units))
    with step("inspect") as progress:
        found = inspect_labels(masks, progress=progress)
    if json:
        say_json(found.as_dict())
    else:
        say(found.as_text())


def track(
    masks: Annotated[Path, typer.Argument(help="Label masks: TIFF stack or folder.")],
    output: Output,
    raw: Annotated[
        Path | None, typer.Option(help="The recorded movie: adds image correlation.")
    ] = None,
    pixel_size: PixelSize = None,
    frame_interval: FrameInterval = None,
    units: UnitsOption = UnitChoice.physical,
    max_distance: Annotated[
        float | None,
        typer.Option(
            help="Longest displacement between frames, in um; chosen from the data when absent.",
            metavar="UM",
        ),
    ] = None,
    divisions: Annotated[bool, typer.Option(help="Look for divisions.")] = True,
    max_gap: Annotated[
        int,
        typer.Option(
            help="Frames that a cell may be missing and still be followed; 0 for masks that miss "
            "none.",
            metavar="FRAMES",
        ),
    ] = 2,
    linker: Annotated[
        Linker, typer.Option(help="'trackpy' is the plain nearest-neighbour baseline.")
    ] = Linker.cues,
    export: Annotated[
        Literal["ctc"] | None,
        typer.Option(help="Also write DIR/ctc, a CTC folder; 'cellquant export' writes others."),
    ] = None,
    progress: ProgressOption = Progress.auto,
) -> None:
    """Link the cells of label masks into trajectories: DIR/tracks.parquet and DIR/cells.parquet."""
    from cellquant.cli.text import track_lines
    from cellquant.io import read_images, read_labels
    from cellquant.pipeline import track_movie

    stack = read_labels(masks, **_calibration(pixel_size, frame_interval, units))
    options: dict[str, Any] = {
        "max_distance": max_distance,
        "divisions": divisions,
        "linker": linker.value,
        "max_gap": max_gap,
    }
    cells, tracks, _ = track_movie(
        stack,
        output,
        raw=None if raw is None else read_images(raw),
        options=options,
        export_ctc=export is not None,
        step=step,
    )
    for line in track_lines(stack, cells, tracks):
        say(line)
    note(f"wrote {output / 'tracks.parquet'}")


def segment(
    images: Annotated[Path, typer.Argument(help="The recorded movie.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="The mask stack to write.")],
    backend: Annotated[Backend, typer.Option(help="How to segment.")] = Backend.watershed,
    modality: Annotated[
        Modality, typer.Option(help="Kind of image; 'auto' looks at the data (watershed).")
    ] = Modality.auto,
    cell_diameter: Annotated[
        float | None, typer.Option(help="Typical cell diameter in px; estimated when absent.")
    ] = None,
    executable: Annotated[
        str,
        typer.Option(help="micro-sam's automatic segmentation program in your own install."),
    ] = "micro_sam.automatic_segmentation",
    model: Annotated[str, typer.Option(help="micro-sam model.")] = "vit_b_lm",
) -> None:
    """Make label masks from a recorded movie."""
    from cellquant.io import read_images
    from cellquant.segment.backends import segment_micro_sam, segment_watershed

    movie = read_images(images)
    with step("segment") as progress:
        if backend is Backend.watershed:
            segment_watershed(
                movie,
                output,
                modality=modality.value,
                cell_diameter=cell_diameter,
                progress=progress,
            )
        else:
            segment_micro_sam(images, output, executable=executable, model=model)
    say(f"wrote {output}")


def evaluate(
    tracks: Annotated[Path, typer.Argument(help="Folder or parquet file of tracks.")],
    truth: Annotated[Path, typer.Option(help="CTC folder with the true tracks.")],
    json: Annotated[Path | None, typer.Option(help="Write the scores to this file.")] = None,
    frame_tolerance: Annotated[
        int, typer.Option(help="Frames by which a division may be off in the tolerant score.")
    ] = 1,
    min_points: Annotated[
        int | None,
        typer.Option(help="Consecutive points of a trajectory whose dynamics are compared; 24."),
    ] = None,
) -> None:
    """Score tracks against the truth: edge F1, division F1, LNK, TRA, IDF1.

    Tells besides how far MSD, F_s and tau_alpha are off because of wrong links.
    """
    from cellquant.storage import write_json
    from cellquant.tables import read_tracks
    from cellquant.track.consequences import dynamics_error
    from cellquant.track.evaluate import evaluate as score_tracks

    found = read_tracks(tracks)
    scores = score_tracks(found, truth, frame_tolerance=frame_tolerance)
    points = {} if min_points is None else {"min_points": min_points}
    dynamics = dynamics_error(found, truth, **points)
    for line in (*scores.as_lines(), *dynamics.as_lines()):
        say(line)
    if json is not None:
        write_json(json, {**scores.as_dict(), "dynamics": dynamics.as_dict()})


def observe(
    source: Annotated[
        list[str] | None,
        typer.Argument(help="Tracks, a simulated run, or masks (shapes alone).", metavar="SOURCE"),
    ] = None,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Output folder.")] = None,
    only: Annotated[
        list[str] | None, typer.Option(help="Only these observables: --only NAME [NAME ...].")
    ] = None,
    list_: Annotated[bool, typer.Option("--list", help="List the observables and exit.")] = False,
    smoothing: Annotated[
        int | None,
        typer.Option(help="Points of the moving average; 5 for movies, 1 for runs by default."),
    ] = None,
    min_points: Annotated[
        int | None, typer.Option(help="Consecutive points that a trajectory must have.")
    ] = None,
    window: Annotated[
        int | None,
        typer.Option(help="Frames of an analysis window; 24 for movies, a whole run by default."),
    ] = None,
    bin_width: Annotated[float | None, typer.Option(help="Density bins, cells/mm^2.")] = None,
    bin_centres: Annotated[
        str | None, typer.Option(help="Centres of the density bins, e.g. 1100,1350,1600.")
    ] = None,
    drift: Annotated[
        bool, typer.Option(help="Remove the motion of the centre of mass of the population.")
    ] = True,
    keep_cut_cells: Annotated[
        bool,
        typer.Option(
            "--keep-cut-cells", help="Let cells that the border of the image cuts into the motion."
        ),
    ] = False,
    wave_number: Annotated[
        str, typer.Option(help="q: '2pi/d', 'structure_factor_peak' or a number in 1/length unit.")
    ] = "2pi/d",
    scattering: Annotated[
        str, typer.Option(help="'bessel', the exact isotropic average, or 'vectors'.")
    ] = "bessel",
    lags: Annotated[
        str | None, typer.Option(help="Lags in frames, e.g. 1,2,5,10; about 35 by default.")
    ] = None,
    stride: Annotated[int, typer.Option(help="Frames between time origins.")] = 1,
    overlap_cutoff: Annotated[
        float | None,
        typer.Option(help="Distance of the overlap function; 0.3 mean diameters by default."),
    ] = None,
    van_hove_lag: Annotated[
        float | None, typer.Option(help="Lag of the van Hove function; tau_alpha by default.")
    ] = None,
    core_range: Annotated[
        tuple[float, float] | None,
        typer.Option(help="Range of the Gaussian fit, in mean diameters.", metavar="FROM TO"),
    ] = None,
    tail_range: Annotated[
        tuple[float, float] | None,
        typer.Option(help="Range of the exponential fit, in mean diameters.", metavar="FROM TO"),
    ] = None,
    max_frames: Annotated[
        int, typer.Option(help="Frames, evenly spaced, on which structure is measured.")
    ] = 32,
    pixel_size: PixelSize = None,
    frame_interval: FrameInterval = None,
    units: UnitsOption = UnitChoice.physical,
) -> None:
    """Measure observables: DIR/summary.json and one tidy table for each."""
    from cellquant.cli.text import summary_lines
    from cellquant.observables import available_observables
    from cellquant.pipeline import observe_source

    known = available_observables()
    if list_:
        for name, meaning in known.items():
            say(f"{name:32s} {meaning}")
        return
    # Names that follow '--only NAME' arrive among the arguments.
    paths = [argument for argument in source or [] if not (only and argument in known)]
    wanted = [*(only or []), *(name for name in source or [] if name not in paths)]
    if len(paths) != 1 or output is None:
        raise InputError(
            f"observe needs one SOURCE and -o DIR, got {len(paths)} sources "
            f"{paths or ''}; '--list' shows the names that may follow --only."
        )
    given = {
        "smoothing": smoothing,
        "min_points": min_points,
        "window": window,
        "bin_width": bin_width,
        "bin_centres": _numbers("bin-centres", bin_centres, float),
        "drift": drift,
        "keep_cut_cells": keep_cut_cells,
        "wave_number": _wave_number(wave_number),
        "scattering": scattering,
        "lags": _numbers("lags", lags, int),
        "stride": stride,
        "overlap_cutoff": overlap_cutoff,
        "van_hove_lag": van_hove_lag,
        "core_range": core_range,
        "tail_range": tail_range,
        "max_frames": max_frames,
    }
    observables, _ = observe_source(
        paths[0],
        output,
        only=wanted or None,
        options={key: value for key, value in given.items() if value is not None},
        calibration=_calibration(pixel_size, frame_interval, units),
        step=lambda label: step(label, unit="frames"),
    )
    for line in summary_lines(observables.summary):
        say(line)
    note(f"wrote {output / 'summary.json'}")


def _numbers(option: str, text: str | None, kind: type[int] | type[float]) -> Any:
    if text is None:
        return None
    try:
        return [kind(part) for part in text.split(",")]
    except ValueError:
        raise InputError(
            f"--{option} takes numbers separated by commas, got {text!r}; e.g. 1,2,5."
        ) from None


def _wave_number(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text


def export(
    tracks: Annotated[Path, typer.Argument(help="Folder or parquet file of tracks.")],
    to: Annotated[TrackFormat, typer.Option(help="Format to write.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="File or folder to write.")],
    masks: Annotated[
        Path | None, typer.Option(help="The label masks (needed for the CTC format).")
    ] = None,
) -> None:
    """Write tracks for another program."""
    from cellquant.io import export_tracks, read_labels
    from cellquant.tables import read_tracks

    stack = None if masks is None else read_labels(masks, units="pixel")
    export_tracks(read_tracks(tracks), to.value, output, masks=stack)
    say(f"wrote {output}")


def register(app: typer.Typer) -> None:
    """Add these commands to the program."""
    for command in (inspect, segment, track, evaluate, observe, export):
        app.command()(command)

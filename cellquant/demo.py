"""The main job on the embedded recording: masks to tracks to observables to a report."""

import shutil
from importlib.resources import as_file, files
from pathlib import Path

from cellquant.pipeline import Step, observe_into, silent, track_movie
from cellquant.storage import atomic_path, check_output, write_json


def run_demo(out: str | Path, *, seed: int = 1, step: Step = silent) -> Path:
    """Analyse the embedded recording and write everything into one folder.

    Parameters
    ----------
    out
        Output folder: the masks, the tables, ``summary.json`` and ``report.html``.
    seed
        Seed of the bootstrap errors.
    step
        Gives a progress callback for each stage.

    Returns
    -------
    pathlib.Path
        The report.

    Raises
    ------
    InputError
        If the output cannot be written.
    """
    from cellquant.compare.report import experiment_report
    from cellquant.io import inspect_labels, read_labels

    folder = check_output(out)
    with as_file(files("cellquant") / "demo_data") as embedded:
        for name in ("masks.tif", "NOTICE.md"):
            with atomic_path(folder / name) as path:
                shutil.copyfile(embedded / name, path)
    masks = read_labels(folder / "masks.tif", units="pixel")
    with step("inspect") as progress:
        write_json(folder / "inspection.json", inspect_labels(masks, progress=progress).as_dict())
    cells, tracks, record = track_movie(masks, folder, step=step)
    observables = observe_into(tracks, folder, record, step=step)
    record.command = "demo"
    record.settings = {**record.settings, "seed": seed}
    report = folder / "report.html"
    with record.stage("report"), step("report"):
        experiment_report(
            title="T98G glioma cells, phase contrast",
            tracks=tracks,
            observables=observables,
            settings=record.as_dict(),
            out=report,
            stack=masks,
            cells=cells,
        )
    record.write(folder)
    return report

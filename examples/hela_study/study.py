"""The HeLa study, scaled down: simulated movies through the whole of cellquant to one report.

    python examples/hela_study/study.py -o study --workers 2

Three conditions with eight trials each; a trial is three fields of view, from sparse to crowded.
Movies of the real study are not public, so the deformable-cell model stands in for them: cells are
simulated, drawn as label masks and forgotten, and from there on everything is measured. What was
planted: cells move 26 % slower under low nutrient and 8 % slower under the Rac1 inhibitor, trials
of one condition differ by 5 %, and nothing else differs between the conditions.
"""

import argparse
import math
import shutil
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

HERE = Path(__file__).parent
SPEED = {"untreated": 0.07, "low nutrient": 0.74 * 0.07, "Rac1 inhibitor": 0.92 * 0.07}
TRIALS = 8
# Cells per mm^2 and packing fraction of the three fields: cells spread where there is room.
FIELDS = ((1350.0, 0.86), (1850.0, 0.92), (2350.0, 0.98))
CELLS = 100
FRAME = 5.0  # t0 between frames, which stands for 10 min
FRAMES = 49  # two windows of 24
PIXEL = 1.0  # um


@dataclass(frozen=True)
class Movie:
    """One field of view: where its masks go, and the scene behind it."""

    path: Path
    density: float
    phi: float
    v0: float
    seed: int


def planned_movies(folder: Path) -> list[Movie]:
    """All movies of the study, the same in every run."""
    import numpy as np

    rng = np.random.default_rng(2026)
    movies = []
    for condition, speed in SPEED.items():
        for trial in range(1, TRIALS + 1):
            v0 = speed * rng.normal(1.0, 0.05)
            crowding = rng.normal(1.0, 0.04)
            for field, (density, phi) in enumerate(FIELDS, start=1):
                path = folder / condition / f"trial {trial}" / f"field {field}.tif"
                movies.append(Movie(path, density * crowding, phi, v0, len(movies) + 1))
    return movies


def make_movie(movie: Movie) -> None:
    """Simulate a field and draw its masks, unless they are there already."""
    from cellquant.sim import Scene, render, simulate

    if movie.path.exists():
        return
    scene = Scene(
        phi=movie.phi,
        v0=movie.v0,
        eta=0.01,
        n_cells=CELLS,
        D_r=0.02,
        seed=movie.seed,
    )
    run = simulate(scene, duration=FRAME * (FRAMES - 1), transient=50.0, save_every=FRAME)
    diameter = math.sqrt(4.0 * movie.phi / (math.pi * movie.density * 1e-6))
    truth = movie.path.with_name(movie.path.stem + "_truth")
    masks = movie.path.with_name(movie.path.stem + ".partial.tif")
    render(run, masks, pixel_size=PIXEL, length=diameter, time=10.0 / FRAME, truth=truth)
    shutil.rmtree(truth)
    masks.rename(movie.path)


def main() -> None:
    """Make the movies, then run the four commands of the study."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    out: Path = options.output.resolve()
    out.mkdir(parents=True, exist_ok=True)
    movies = planned_movies(out / "movies")
    with ProcessPoolExecutor(options.workers, mp_context=get_context("spawn")) as pool:
        for number, _ in enumerate(pool.map(make_movie, movies), start=1):
            print(f"\rmovies: {number} of {len(movies)}", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    for name in ("experiment.toml", "sweep.toml", "units.toml"):
        shutil.copyfile(HERE / name, out / name)
    workers = ["--workers", str(options.workers)]
    for command in (
        ["run", "experiment.toml", "-o", "experiment", *workers],
        ["sweep", "sweep.toml", "-o", "sweep", *workers],
        ["compare", "experiment", "sweep", "-o", "report.html", "--fit", "--units", "units.toml"],
    ):
        print("cellquant", *command, file=sys.stderr)
        subprocess.run([sys.executable, "-m", "cellquant", *command], cwd=out, check=True)
    print(out / "report.html")


if __name__ == "__main__":
    main()

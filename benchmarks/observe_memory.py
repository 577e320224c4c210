"""Peak memory and cost of `cellquant observe` on long movies and runs on disk.

    python benchmarks/observe_memory.py [--only GROUP ...] [--kind movie|run ...]

Walkers, 4000 cells x 500 frames and 1024 x 2000, written as tracks.parquet in an open field (a
movie) and as RUN.zarr with trembling contours in a periodic box (a run). Every measurement runs
in a process of its own that has observed a movie of 70 x 60 before, so that the interpreter, its
libraries and the compiled code do not count: what is added is the peak of the resident memory from
there. A trajectory is the bytes of its positions, 16 per cell and frame. Writes
results/observe_memory.json. Linux alone.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from itertools import product
from pathlib import Path

os.environ["NUMBA_NUM_THREADS"] = "1"
os.environ["OMP_NUM_THREADS"] = "1"

import numpy as np
import pandas as pd

from cellquant.pipeline import observe_source
from cellquant.sim import Scene
from cellquant.sim.archive import append_frames, create_group, write_constants
from cellquant.tables import REDUCED, TRACK_COLUMNS, Tracks

RESULTS = Path(__file__).parent / "results"
SIZES = {"4000 x 500": (4000, 500), "1024 x 2000": (1024, 2000)}
GROUPS = {
    "F_s and tau_alpha": ["self_intermediate_scattering", "tau_alpha"],
    "shape index": ["shape_index"],
    "windows": ["windows"],
    "van Hove": ["van_hove"],
    "everything": None,
}


def write_walkers(path: Path, n_cells: int, n_frames: int) -> None:
    """Independent walkers whose F_s decays within the movie."""
    rng = np.random.default_rng(1)
    steps = rng.normal(0, 0.02, (n_cells, n_frames, 2))
    steps[:, 0] = rng.uniform(0, np.sqrt(n_cells), (n_cells, 2))
    place = np.cumsum(steps, axis=1).reshape(-1, 2)
    n = len(place)
    frame = np.tile(np.arange(n_frames), n_cells)
    track = np.repeat(np.arange(1, n_cells + 1), n_frames)
    area = rng.normal(0.78, 0.05, n)
    shape = 3.7 + rng.gamma(4, 0.05, n)
    table = pd.DataFrame(
        {
            "frame": frame, "label": track, "x": place[:, 0], "y": place[:, 1], "area": area,
            "perimeter": shape * np.sqrt(area), "shape_index": shape, "aspect_ratio": 1.5,
            "orientation": 0.0, "touches_border": False, "n_neighbours": 6, "track_id": track,
            "parent_track_id": 0, "time": frame.astype(float),
        }
    ).astype(dict(TRACK_COLUMNS))  # fmt: skip
    Tracks(table, REDUCED, 1.0, float(n_cells)).write(path)


def write_run(path: Path, n_cells: int, n_frames: int) -> None:
    """The same walkers as a run; only the file is that of a simulation."""
    rng = np.random.default_rng(1)
    scene = Scene(n_cells=n_cells)
    settings = {"contact": "exact", "points": None, "integrator": "euler", "dt": 1.0}
    settings |= {"tolerance": None, "save_every": 1.0, "transient": 0.0, "duration": n_frames}
    group = create_group(path, scene, settings)
    edge = float(np.sqrt(n_cells))
    write_constants(group, np.full(n_cells, 0.5), np.array([edge, edge]))
    place = rng.uniform(0, edge, (n_cells, 2))
    for start in range(0, n_frames, 100):
        n = min(100, n_frames - start)
        states = rng.normal(0, 0.03, (n, n_cells, 3 + 2 * (scene.modes - 1)))
        states[:, :, :2] = place + np.cumsum(rng.normal(0, 0.02, (n, n_cells, 2)), axis=0)
        place = states[-1, :, :2]
        append_frames(group, start, np.arange(start, start + n, dtype=float), states)
    group.attrs["status"] = "complete"


WRITERS = {"movie": ("tracks.parquet", write_walkers), "run": ("run.zarr", write_run)}


def status(field: str) -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(field):
            return int(line.split()[1]) * 1024
    raise RuntimeError(f"/proc/self/status has no {field}")


def measure(path: Path, group: str) -> dict[str, float]:
    """Memory and processor time that one command adds."""
    with tempfile.TemporaryDirectory() as folder:
        kind = "run" if path.suffix == ".zarr" else "movie"
        small = Path(folder) / "small" / path.name
        small.parent.mkdir()
        WRITERS[kind][1](small, 70, 60)
        observe_source(small, Path(folder) / "out", only=GROUPS[group])
        Path("/proc/self/clear_refs").write_text("5")  # the peak starts anew
        before, started = status("VmRSS"), time.process_time()
        observe_source(path, Path(folder) / "out", only=GROUPS[group])
        return {"added": status("VmHWM") - before, "cpu_s": time.process_time() - started}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="+", choices=list(GROUPS), default=list(GROUPS))
    parser.add_argument("--kind", nargs="+", choices=list(WRITERS), default=list(WRITERS))
    parser.add_argument("--measure", nargs=2, metavar=("PATH", "GROUP"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.measure:
        path, group = arguments.measure
        print(json.dumps(measure(Path(path), group)))
        return
    found: dict[str, dict[str, dict[str, float]]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for kind, (size, (n_cells, n_frames)) in product(arguments.kind, SIZES.items()):
            name, write = WRITERS[kind]
            path = Path(folder) / f"{kind} {n_cells}" / name
            path.parent.mkdir()
            write(path, n_cells, n_frames)
            for group in arguments.only:
                command = [sys.executable, __file__, "--measure", str(path), group]
                done = subprocess.run(command, capture_output=True, text=True, check=True)
                row = json.loads(done.stdout.splitlines()[-1])
                row["trajectory"] = 16 * n_cells * n_frames
                row["trajectories"] = row["added"] / row["trajectory"]
                found.setdefault(f"{kind} {size}", {})[group] = row
                print(
                    f"{kind:6s} {size:12s} {group:20s} {row['added'] / 1e6:7.0f} MB   "
                    f"{row['trajectories']:5.2f} trajectories   {row['cpu_s']:6.1f} s",
                    flush=True,
                )
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "observe_memory.json").write_text(json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()

"""Cost of each stage, fitted on small inputs and checked at ten times their size.

    python benchmarks/scale.py

Every job is a `cellquant` command in a process of its own; its record gives processor time by
stage, the system its peak memory, the folder its size on disk. The cost of a stage is taken as
proportional to its amount of work (pixels, cells times frames, cells times simulated time) above a
constant, fitted on the two small sizes and compared with the large one. Writes
benchmarks/results/scale.json and the table of docs/scale.md.
"""

import json
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from synthetic_layer import make_movie

HERE = Path(__file__).resolve().parent
RESULTS = HERE / "results" / "scale.json"
PAGE = HERE.parent / "docs" / "scale.md"
BEGIN, END = "<!-- costs: generated -->", "<!-- end -->"
FRAMES = (12, 24, 240)  # the first two are fitted, the last is ten times the second
TIMES = (8, 16, 160)
SIZE, CELLS, SIMULATED = 512, 64, 100


def command(*words: str) -> float:
    """Run a command; returns its peak memory in MB."""
    environment = {**os.environ, "NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    code = (
        "import resource, subprocess, sys\n"
        "subprocess.run(sys.argv[1:], check=True, stdout=subprocess.DEVNULL)\n"
        "print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)\n"
    )
    full = [sys.executable, "-c", code, sys.executable, "-m", "cellquant", *words]
    done = subprocess.run(full, check=True, capture_output=True, text=True, env=environment)
    return int(done.stdout.split()[-1]) * 1024 / 1e6


def stages(folder: Path) -> dict[str, float]:
    record = json.loads((folder / "run.json").read_text())
    return {part["stage"]: part["cpu_s"] for part in record["stages"]}


def size_of(folder: Path) -> float:
    return sum(p.stat().st_size for p in folder.rglob("*") if p.is_file()) / 1e6


def movie(folder: Path, frames: int) -> dict[str, float]:
    """Processor time of each stage, memory and disk of tracking and observing one movie."""
    masks, out, seen = folder / f"{frames}.tif", folder / f"t{frames}", folder / f"o{frames}"
    make_movie(masks, n_frames=frames, n_cells=CELLS, size=SIZE, seed=1)
    options = ("--pixel-size", "0.65", "--frame-interval", "10")
    track_MB = command("track", str(masks), "-o", str(out), *options)
    observe_MB = command("observe", str(out), "-o", str(seen))
    tracked, observed = stages(out), stages(seen)
    return {
        "measure cells": tracked["measure"],
        "link cells": tracked["link"],
        "observe tracks": observed["observe"],
        "memory of track, MB": track_MB,
        "memory of observe, MB": observe_MB,
        "disk, MB": size_of(out) + size_of(seen),
    }


def simulation(folder: Path, time: int) -> dict[str, float]:
    sweep, out = folder / f"{time}.toml", folder / f"s{time}"
    sweep.write_text(f"[scene]\ncells = {SIMULATED}\ntransient = 0\nduration = {time}\n")
    memory = command("sweep", str(sweep), "-o", str(out))
    cost = stages(next((out / "runs").iterdir()))
    return {
        "simulate": cost["simulate"],
        "observe a run": cost["observe"],
        "memory of sweep, MB": memory,
        "disk of a run, MB": size_of(out),
    }


def fit(sizes: tuple[int, ...], costs: list[float], unit: float) -> dict[str, float]:
    """Constant and slope from the first two sizes; what they say of the third."""
    slope = (costs[1] - costs[0]) / (sizes[1] - sizes[0])
    constant = costs[0] - slope * sizes[0]
    expected = constant + slope * sizes[2]
    # The slope over the whole range is the one to use: the small sizes hardly differ.
    return {
        "constant": constant,
        "slope": slope / unit,
        "expected": expected,
        "measured": costs[2],
        "overall_slope": (costs[2] - costs[1]) / (sizes[2] - sizes[1]) / unit,
    }


def main() -> None:
    rows: dict[str, dict[str, Any]] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        movie(folder, 6)  # compiles
        simulation(folder, 4)
        for sizes, job, cells, noun in (
            (FRAMES, movie, CELLS, "cell and frame"),
            (TIMES, simulation, SIMULATED, "cell and t0"),
        ):
            found = [job(folder, size) for size in sizes]
            for key in found[0]:
                costs = [each[key] for each in found]
                rows[key] = {
                    "per": noun,
                    "sizes": sizes,
                    "costs": costs,
                    **fit(sizes, costs, cells),
                }
    content = {"cores": len(os.sched_getaffinity(0)), "load": os.getloadavg()[0], "costs": rows}
    RESULTS.write_text(json.dumps(content, indent=2) + "\n")
    lines = [
        "| cost | per | small sizes | constant | slope | expected at ten times | measured |",
        "|---|---|---|---|---|---|---|",
    ]
    for key, row in rows.items():
        memory = "MB" in key
        scale, unit = (1e3, "kB") if memory else (1e6, "us")
        number, what = ("MB", "") if memory else ("s", "")
        lines.append(
            f"| {key} | {row['per']} | {row['costs'][0]:.3g}, {row['costs'][1]:.3g} {number} "
            f"| {row['constant']:.3g} {number} | {scale * row['overall_slope']:.3g} {unit}{what} "
            f"| {row['expected']:.3g} {number} | {row['measured']:.3g} {number} |"
        )
    page = PAGE.read_text(encoding="utf-8")
    before, rest = page.split(BEGIN)
    text = "\n".join(lines)
    PAGE.write_text(f"{before}{BEGIN}\n{text}\n{END}{rest.split(END)[1]}", encoding="utf-8")
    print(text)
    print(f"peak memory of this process: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss} kB")


if __name__ == "__main__":
    main()

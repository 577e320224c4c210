"""Cost of each stage, fitted on small inputs and checked at ten times their size.

    python benchmarks/scale.py [--repeats 3]

Every job is a `cellquant` command in a process of its own; its record gives processor time by
stage, the system its peak memory, the folder its size on disk. A cost is a constant plus a slope
times the amount of work (cells times frames, cells times simulated time), fitted on the two small
sizes and compared with the large one. The small jobs are repeated and the least is taken: other
work on the machine only adds to a cost. A sweep is estimated with `--estimate` and then made.
Writes benchmarks/results/scale.json and the tables of docs/scale.md.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from synthetic_layer import make_movie

HERE = Path(__file__).resolve().parent
RESULTS = HERE / "results" / "scale.json"
PAGE = HERE.parent / "docs" / "scale.md"
END = "<!-- end -->"
FRAMES = (200, 400, 4000)  # the first two are fitted, the last is ten times the second
TIMES = (200, 400, 4000)
SWEEP = """
seeds = [1, 2]
[scene]
cells = {cells}
transient = 20
duration = 60
[grid]
phi = [0.9, 0.97]
v0 = [0.01, 0.05]
"""
SIZE, CELLS, SIMULATED = 512, 64, 100
CHILD = """
import resource, subprocess, sys
subprocess.run(sys.argv[1:], check=True, stderr=subprocess.DEVNULL)
print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss, file=sys.stderr)
"""


def run(*words: str) -> "subprocess.CompletedProcess[str]":
    """Run a command with one thread."""
    environment = {**os.environ, "NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    full = [sys.executable, "-c", CHILD, sys.executable, "-m", "cellquant", *words]
    return subprocess.run(full, check=True, capture_output=True, text=True, env=environment)


def command(*words: str) -> float:
    """Run a command; returns its peak memory in MB."""
    return int(run(*words).stderr.split()[-1]) * 1024 / 1e6


def stages(folder: Path) -> dict[str, float]:
    record = json.loads((folder / "run.json").read_text())
    return {part["stage"]: part["cpu_s"] for part in record["stages"]}


def size_of(folder: Path) -> float:
    return sum(p.stat().st_size for p in folder.rglob("*") if p.is_file()) / 1e6


def movie(folder: Path, frames: int) -> dict[str, float]:
    """Processor time of each stage, memory and disk of tracking and observing one movie."""
    masks, out, seen = folder / f"{frames}.tif", folder / f"t{frames}", folder / f"o{frames}"
    if not masks.exists():
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
    shutil.rmtree(out, ignore_errors=True)
    sweep.write_text(f"[scene]\ncells = {SIMULATED}\ntransient = 0\nduration = {time}\n")
    memory = command("sweep", str(sweep), "-o", str(out))
    cost = stages(next((out / "runs").iterdir()))
    return {
        "simulate": cost["simulate"],
        "observe a run": cost["observe"],
        "memory of sweep, MB": memory,
        "disk of a run, MB": size_of(out),
    }


def estimated(folder: Path, cells: int) -> dict[str, float]:
    """What a sweep was said to cost, and what it cost."""
    sweep, out = folder / f"e{cells}.toml", folder / f"e{cells}"
    sweep.write_text(SWEEP.format(cells=cells))
    told = json.loads(run("sweep", str(sweep), "--estimate", "--json").stdout)
    memory = command("sweep", str(sweep), "-o", str(out))
    found = [stages(each) for each in sorted((out / "runs").iterdir())]
    runs = [part for each in (out / "runs").iterdir() for part in each.rglob("*") if part.is_file()]
    return {
        "simulate_s": told["simulate_s"],
        "simulate_s, measured": sum(each["simulate"] for each in found),
        "observe_s": told["observe_s"],
        "observe_s, measured": sum(each["observe"] for each in found),
        "memory_MB": told["memory_MB"],
        "memory_MB, measured": memory,
        "disk_MB": told["disk_MB"],
        "disk_MB, measured": sum(part.stat().st_size for part in runs) / 1e6,
    }


def fit(sizes: tuple[int, ...], costs: list[float], unit: float) -> dict[str, float]:
    """Constant and slope from the first two sizes; what they say of the third."""
    slope = (costs[1] - costs[0]) / (sizes[1] - sizes[0])
    constant = costs[0] - slope * sizes[0]
    return {
        "constant": constant,
        "slope": slope / unit,
        "expected": constant + slope * sizes[2],
        "measured": costs[2],
    }


def write(page: str, begin: str, lines: list[str]) -> str:
    """The page with these lines between its marks."""
    before, rest = page.split(begin)
    text = "\n".join(lines)
    print(text)
    return f"{before}{begin}\n{text}\n{END}{rest.split(END, 1)[1]}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    rows: dict[str, dict[str, Any]] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        movie(folder, 6)  # compiles
        simulation(folder, 4)
        for sizes, job, cells, noun in (
            (FRAMES, movie, CELLS, "cell and frame"),
            (TIMES, simulation, SIMULATED, "cell and t0"),
        ):
            found = []
            for place, size in enumerate(sizes):
                repeats = arguments.repeats if place < 2 else 1
                jobs = [job(folder, size) for _ in range(repeats)]
                found.append({key: min(each[key] for each in jobs) for key in jobs[0]})
            for key in found[0]:
                costs = [each[key] for each in found]
                rows[key] = {
                    "per": noun,
                    "sizes": sizes,
                    "costs": costs,
                    **fit(sizes, costs, cells),
                }
        estimates = {str(cells): estimated(folder, cells) for cells in (64, 256)}
    content = {
        "cores": len(os.sched_getaffinity(0)),
        "load": os.getloadavg()[0],
        "costs": rows,
        "estimates": estimates,
    }
    RESULTS.write_text(json.dumps(content, indent=2) + "\n")
    lines = [
        "| cost | per | small sizes | constant | slope | expected at ten times | measured |",
        "|---|---|---|---|---|---|---|",
    ]
    for key, row in rows.items():
        memory = "MB" in key
        scale, unit = (1e3, "kB") if memory else (1e6, "us")
        number = "MB" if memory else "s"
        lines.append(
            f"| {key} | {row['per']} | {row['costs'][0]:.3g}, {row['costs'][1]:.3g} {number} "
            f"| {row['constant']:.3g} {number} | {scale * row['slope']:.3g} {unit} "
            f"| {row['expected']:.3g} {number} | {row['measured']:.3g} {number} |"
        )
    page = write(PAGE.read_text(encoding="utf-8"), "<!-- costs: generated -->", lines)
    lines = ["| cells | cost | estimated | measured |", "|---|---|---|---|"]
    for cells, found in estimates.items():
        for key in ("simulate_s", "observe_s", "memory_MB", "disk_MB"):
            told, real = found[key], found[f"{key}, measured"]
            lines.append(f"| {cells} | {key} | {told:.3g} | {real:.3g} |")
    page = write(page, "<!-- estimates: generated -->", lines)
    PAGE.write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()

"""Time to measure one frame: cellquant beside regionprops_table and DIPlib.

    python benchmarks/measure_speed.py [--size 2048] [--cells 1000] [--repeats 15]

All run in turn in one process on the same confluent frame; processor time, so that other load on
the machine counts little. cellquant checks and repairs the frame and fills every column of the
table of cells; regionprops_table gives label, area, centroid, axes, orientation and perimeter;
DIPlib gives size and perimeter alone. Writes benchmarks/results/measure_speed.json.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree
from skimage.measure import regionprops_table

from cellquant.io import LabelStack
from cellquant.segment import measure_cells

try:
    import diplib
except ImportError:
    diplib = None

RESULTS = Path(__file__).parent / "results"
PROPERTIES = ("label", "area", "centroid", "axis_major_length", "axis_minor_length")


def frame(size: int, n_cells: int, seed: int = 1) -> np.ndarray:
    """Voronoi tissue of points on a jittered lattice."""
    rng = np.random.default_rng(seed)
    side = int(np.ceil(np.sqrt(n_cells)))
    grid = np.stack(np.divmod(np.arange(side * side), side), axis=-1)[:n_cells]
    seeds = (grid + 0.5 + rng.uniform(-0.3, 0.3, size=(n_cells, 2))) * size / side
    pixels = np.stack(np.mgrid[:size, :size], axis=-1).reshape(-1, 2)
    nearest = cKDTree(seeds).query(pixels)[1].reshape(size, size)
    return rng.permutation(np.arange(1, n_cells + 1))[nearest].astype(np.int32)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=2048)
    parser.add_argument("--cells", type=int, default=1000)
    parser.add_argument("--repeats", type=int, default=15)
    arguments = parser.parse_args()
    labels = frame(arguments.size, arguments.cells)
    stack = LabelStack.from_array(labels, pixel_size=0.65, frame_interval=10)
    unsigned = labels.astype(np.uint32)
    jobs = {
        "cellquant, all columns": lambda: measure_cells(stack),
        "regionprops_table": lambda: regionprops_table(
            labels, properties=(*PROPERTIES, "orientation", "perimeter")
        ),
    }
    if diplib is not None:
        jobs["DIPlib, size and perimeter"] = lambda: diplib.MeasurementTool.Measure(
            unsigned, features=["Size", "Perimeter"]
        )
    times: dict[str, list[float]] = {name: [] for name in jobs}
    for job in jobs.values():
        job()  # compile and warm up
    for _ in range(arguments.repeats):
        for name, job in jobs.items():
            started = time.process_time()
            job()
            times[name].append(1e3 * (time.process_time() - started))
    ours = np.median(times["cellquant, all columns"])
    rows = {}
    print(f"{'':28s}{'median ms':>10s}{'quartiles':>18s}{'ratio to ours':>15s}")
    for name, values in times.items():
        low, median, high = np.percentile(values, [25, 50, 75])
        rows[name] = {
            "median_ms": round(median, 1),
            "quartiles_ms": [round(low, 1), round(high, 1)],
            "ratio_to_cellquant": round(median / ours, 2),
        }
        print(f"{name:28s}{median:10.1f}{f'{low:.1f} - {high:.1f}':>18s}{median / ours:15.2f}")
    result = {
        "size": arguments.size,
        "cells": len(np.unique(labels)),
        "repeats": arguments.repeats,
        "clock": "process time",
        "jobs": rows,
    }
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "measure_speed.json").write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()

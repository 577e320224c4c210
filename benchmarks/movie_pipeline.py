"""Cost of a whole movie: 145 frames of 2048 x 2048 with 1000 cells, read, measured and linked.

    python benchmarks/movie_pipeline.py [--frames 145] [--size 2048] [--cells 1000]

Makes the stack, then runs ``cellquant track`` on it in a process of its own, and reports wall
time, processor time and peak memory of that process beside the number of frames.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from synthetic_layer import make_movie

RESULTS = Path(__file__).parent / "results"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=145)
    parser.add_argument("--size", type=int, default=2048)
    parser.add_argument("--cells", type=int, default=1000)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        masks = Path(folder) / "masks.tif"
        make_movie(
            masks,
            n_frames=arguments.frames,
            n_cells=arguments.cells,
            size=arguments.size,
            seed=1,
        )
        command = [sys.executable, "-m", "cellquant", "track", str(masks), "-o", f"{folder}/out"]
        command += ["--pixel-size", "0.65", "--frame-interval", "10"]
        started = time.perf_counter()
        subprocess.run(command, check=True)
        wall = time.perf_counter() - started
        usage = resource.getrusage(resource.RUSAGE_CHILDREN)
        record = json.loads((Path(folder) / "out" / "run.json").read_text())
    result = {
        "frames": arguments.frames,
        "size": arguments.size,
        "cells_per_frame": arguments.cells,
        "wall_s": round(wall, 2),
        "cpu_s": round(usage.ru_utime + usage.ru_stime, 2),
        "peak_memory_MB": round(usage.ru_maxrss / 1024),
        "cores": len(os.sched_getaffinity(0)),
        "stages": record["stages"],
    }
    print(json.dumps(result, indent=2))
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "movie_pipeline.json").write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()

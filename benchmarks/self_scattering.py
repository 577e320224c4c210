"""Cost of F_s and MSD: 1024 tracks x 2000 frames, 8 wave vectors, 35 log-spaced lags, all origins.

    python benchmarks/self_scattering.py [--tracks 1024] [--frames 2000] [--rounds 9]

Every side does the same work on one thread, one after the other in each round, and is checked
against the first. The baselines are written out below:

- direct: numba, ``cos(q . dr)`` for every pair of points;
- tabulated: numba, cosine and sine of every phase by numpy, then products of pairs;
- fft: scipy FFT of ``exp(i q . r)`` with zero padding, which yields all lags;
- msd_fft: the MSD by FFT and running sums (all lags).
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path

os.environ["NUMBA_NUM_THREADS"] = "1"
os.environ["OMP_NUM_THREADS"] = "1"

import numpy as np
import scipy.fft
from numba import njit

from cellquant.observables import kernels
from cellquant.observables.trajectories import Trajectories, log_lags

RESULTS = Path(__file__).parent / "results"
EDGE = 32.0


def walkers(n_tracks: int, n_frames: int) -> Trajectories:
    """Brownian walkers whose F_s decays within the movie."""
    rng = np.random.default_rng(1)
    steps = rng.normal(0, 0.02, (n_tracks, n_frames, 2))
    steps[:, 0] = 0
    place = np.cumsum(steps, axis=1)
    return Trajectories(
        x=np.ascontiguousarray(place[..., 0]).ravel(),
        y=np.ascontiguousarray(place[..., 1]).ravel(),
        valid=np.ones(n_tracks * n_frames, dtype=bool),
        offsets=np.arange(n_tracks + 1) * n_frames,
        first_frame=np.zeros(n_tracks, dtype=np.int64),
        start=rng.uniform(0, EDGE, (n_tracks, 2)),
        centre=rng.uniform(0, EDGE, (n_tracks, 2)),
        origin_frame=0,
        n_frames=n_frames,
        frame_interval=1.0,
        box=(EDGE, EDGE),
    )


@njit(cache=True)
def direct(x, y, vectors, lags):
    out = np.zeros((vectors.shape[0], lags.size))
    for w in range(vectors.shape[0]):
        qx, qy = vectors[w, 0], vectors[w, 1]
        for m in range(lags.size):
            lag = lags[m]
            total = 0.0
            for k in range(x.shape[0]):
                for i in range(x.shape[1] - lag):
                    total += np.cos(qx * (x[k, i + lag] - x[k, i]) + qy * (y[k, i + lag] - y[k, i]))
            out[w, m] = total / (x.shape[0] * (x.shape[1] - lag))
    return out


@njit(cache=True, fastmath=True)
def _products(c, s, lags):
    out = np.zeros(lags.size)
    for m in range(lags.size):
        lag = lags[m]
        total = 0.0
        n = c.shape[1] - lag
        for k in range(c.shape[0]):
            c0, c1, s0, s1 = c[k, :n], c[k, lag:], s[k, :n], s[k, lag:]
            for i in range(n):
                total += c0[i] * c1[i] + s0[i] * s1[i]
        out[m] = total / (c.shape[0] * n)
    return out


def tabulated(x, y, vectors, lags):
    out = []
    for qx, qy in vectors:
        phase = qx * x + qy * y
        out.append(_products(np.cos(phase), np.sin(phase), lags))
    return np.array(out)


def by_fft(x, y, vectors, lags):
    n_frames = x.shape[1]
    size = scipy.fft.next_fast_len(2 * n_frames)
    out = []
    for qx, qy in vectors:
        wave = scipy.fft.fft(np.exp(1j * (qx * x + qy * y)), size, axis=1)
        power = np.sum(wave.real**2 + wave.imag**2, axis=0)
        correlation = scipy.fft.ifft(power).real[:n_frames]
        out.append(correlation[lags] / (x.shape[0] * (n_frames - lags)))
    return np.array(out)


def msd_by_fft(x, y, lags):
    n_frames = x.shape[1]
    size = scipy.fft.next_fast_len(2 * n_frames)
    products = np.zeros(n_frames)
    for values in (x, y):
        wave = scipy.fft.rfft(values, size, axis=1)
        power = np.sum(wave.real**2 + wave.imag**2, axis=0)
        products += scipy.fft.irfft(power, size)[:n_frames]
    square = np.sum(x**2 + y**2, axis=0)
    running = np.r_[0.0, np.cumsum(square)]
    ends = running[n_frames - lags] + running[n_frames] - running[lags]
    return (ends - 2 * products[lags]) / (x.shape[0] * (n_frames - lags))


def memory_of_call(n_tracks: int, n_frames: int) -> dict:
    """Peak memory that the call adds, in a process of its own (Linux)."""
    command = [sys.executable, __file__, "--memory", "--tracks", str(n_tracks)]
    command += ["--frames", str(n_frames)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


def report_memory(n_tracks: int, n_frames: int) -> None:
    lags, vectors = log_lags(n_frames - 1), circle(8)
    kernels.scattering_vectors(walkers(4, 50), log_lags(49), vectors)
    kernels.scattering_bessel(walkers(4, 50), log_lags(49), np.array([6.0]))
    paths = walkers(n_tracks, n_frames)
    Path("/proc/self/clear_refs").write_text("5")  # the peak starts anew
    before = _status("VmRSS")
    kernels.scattering_vectors(paths, lags, vectors)
    kernels.scattering_bessel(paths, lags, np.array([6.0]))
    added = max(_status("VmHWM") - before, 0)
    print(json.dumps({"trajectory": paths.x.nbytes * 2, "added": added}))


def _status(field: str) -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(field):
            return int(line.split()[1]) * 1024
    raise RuntimeError(f"/proc/self/status has no {field}")


def circle(n: int) -> np.ndarray:
    angle = np.pi * (np.arange(n) + 0.5) / n
    return 2 * np.pi * np.column_stack([np.cos(angle), np.sin(angle)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tracks", type=int, default=1024)
    parser.add_argument("--frames", type=int, default=2000)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--memory", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.memory:
        report_memory(arguments.tracks, arguments.frames)
        return
    paths = walkers(arguments.tracks, arguments.frames)
    x, y = (a.reshape(arguments.tracks, arguments.frames) for a in (paths.x, paths.y))
    # 40 candidates leave 35 distinct lags out of 2000 frames.
    lags = log_lags(arguments.frames - 1, 39)
    vectors, q = circle(8), np.array([2 * np.pi])
    pairs = arguments.tracks * (arguments.frames - lags)
    sides = {
        "F_s, cellquant": lambda: (
            kernels.scattering_vectors(paths, lags, vectors).sum(axis=1) / pairs
        ),
        "F_s, tabulated": lambda: tabulated(x, y, vectors, lags),
        "F_s, fft": lambda: by_fft(x, y, vectors, lags),
        "F_s, direct": lambda: direct(x, y, vectors, lags),
        "F_s, cellquant exact J0, 1 q": lambda: (
            kernels.scattering_bessel(paths, lags, q).sum(axis=1) / pairs
        ),
        "MSD, cellquant": lambda: kernels.moments(paths, lags)[0].sum(axis=0) / pairs,
        "MSD, fft": lambda: msd_by_fft(x, y, lags),
    }
    seconds = {name: [] for name in sides}
    results = {name: side() for name, side in sides.items()}  # compiles, too
    for name in ("F_s, tabulated", "F_s, fft", "F_s, direct"):
        worst = np.abs(results[name] - results["F_s, cellquant"]).max()
        assert worst < 1e-12, f"{name} differs by {worst}"
    assert np.allclose(results["MSD, fft"], results["MSD, cellquant"], rtol=1e-8)
    for _ in range(arguments.rounds):
        for name, side in sides.items():
            started = time.process_time()
            side()
            seconds[name].append(time.process_time() - started)
    table = {}
    print(f"{lags.size} lags, {len(vectors)} wave vectors, {pairs.sum():.3g} pairs per vector")
    for name, spent in seconds.items():
        reference = "MSD, cellquant" if name.startswith("MSD") else "F_s, cellquant"
        ratios = sorted(a / b for a, b in zip(spent, seconds[reference], strict=True))
        table[name] = {
            "cpu_s": statistics.median(spent),
            "ratio_to_cellquant": statistics.median(spent) / statistics.median(seconds[reference]),
            "ratio_range": [ratios[0], ratios[-1]],
        }
        row = table[name]
        print(
            f"{name:30s} {row['cpu_s']:7.3f} s   x {row['ratio_to_cellquant']:6.2f} "
            f"({ratios[0]:.2f} to {ratios[-1]:.2f})"
        )
    memory = memory_of_call(arguments.tracks, arguments.frames)
    memory["peak_of_trajectory"] = 1 + memory["added"] / memory["trajectory"]
    print(f"peak memory with the trajectory: {memory['peak_of_trajectory']:.2f} trajectories")
    content = {
        "tracks": arguments.tracks, "frames": arguments.frames, "lags": int(lags.size),
        "vectors": len(vectors), "rounds": arguments.rounds, "sides": table, "memory": memory,
    }  # fmt: skip
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "self_scattering.json").write_text(json.dumps(content, indent=2) + "\n")


if __name__ == "__main__":
    main()

"""Planted trends are found again: from masks to the table at the end."""

import json
import textwrap
from pathlib import Path

import numpy as np
import pytest
import tifffile

from cellquant.batch import run_experiment
from cellquant.io import LabelStack
from cellquant.observables import observe
from cellquant.segment import measure_cells

DENSITIES = (1100.0, 1475.0, 1850.0, 2225.0, 2600.0)  # 1/mm^2
PIXEL, INTERVAL = 0.75, 10.0  # um, min
RADIUS = 4.0  # px
SLOPE, LEVEL = 0.02, 30.0  # min per 1/mm^2; min at 1100/mm^2


def wandering_discs(rng: np.random.Generator, density: float, mobility: float) -> np.ndarray:
    """144 discs on a wide grid, Brownian with tau_alpha = level + slope x density over mobility.

    F_s = exp(-D q^2 t) with q = 2 pi/d: D = d^2/(4 pi^2 tau_alpha).
    """
    spacing = 1 / np.sqrt(density * 1e-6) / PIXEL
    side, n_frames = 12, 24
    tau = (LEVEL + SLOPE * (density - 1100)) / mobility
    variance = 2 * (2 * RADIUS / (2 * np.pi)) ** 2 * INTERVAL / tau
    size = round(side * spacing)
    grid = (np.stack(np.meshgrid(*2 * (np.arange(side),)), -1).reshape(-1, 1, 2) + 0.5) * spacing
    step = rng.normal(0, np.sqrt(variance), (side * side, n_frames, 2))
    step[:, 0] = rng.uniform(-0.1, 0.1, (side * side, 2)) * spacing
    place = grid + np.cumsum(step, axis=1)
    reach = np.arange(-int(RADIUS) - 2, int(RADIUS) + 3)
    movie = np.zeros((n_frames, size, size), np.uint16)
    for frame in range(n_frames):
        names = rng.permutation(side * side) + 1
        for name, (x, y) in zip(names, place[:, frame], strict=True):
            columns, rows = round(x) + reach, round(y) + reach
            inside = (columns[None] - x) ** 2 + (rows[:, None] - y) ** 2 <= RADIUS**2
            r, c = np.nonzero(inside)
            r, c = rows[r], columns[c]
            shown = (r >= 0) & (r < size) & (c >= 0) & (c < size)
            movie[frame, r[shown], c[shown]] = name
    return movie


@pytest.mark.slow
def test_relaxation_that_slows_with_density_is_found_from_masks(tmp_path: Path) -> None:
    # Eight trials that differ in mobility by 10 %, five densities each.
    rng = np.random.default_rng(0)
    text = textwrap.dedent(
        f"""
        [calibration]
        pixel_size = {PIXEL}
        frame_interval = {INTERVAL}
        [observables]
        only = ["density", "tau_alpha", "windows", "self_intermediate_scattering"]
        smoothing = 1
        bin_width = 375.0
        bin_centres = {list(DENSITIES)}
        [[condition]]
        name = "planted"
        """
    )
    for trial in range(8):
        mobility = rng.lognormal(0, 0.1)
        for density in DENSITIES:
            path = tmp_path / f"t{trial}" / f"{density:.0f}.tif"
            path.parent.mkdir(exist_ok=True)
            tifffile.imwrite(path, wandering_discs(rng, density, mobility), compression="zlib")
        text += f'[[condition.trial]]\nname = "trial {trial}"\nstacks = ["t{trial}/*.tif"]\n'
    (tmp_path / "experiment.toml").write_text(text)
    out = tmp_path / "out"
    done = run_experiment(tmp_path / "experiment.toml", out, workers=2)
    assert (done.done, done.failures) == (40, {})
    found = json.loads((out / "statistics.json").read_text())["mixed_model"]["planted"]
    assert found["n"] + found["n_censored"] >= 40
    assert found["n_groups"] == 8
    low, high = found["interval_95"]
    assert low <= SLOPE <= high
    assert found["std_error"] < 0.2 * SLOPE
    assert found["p_value"] < 1e-3


def shaped_cells(rng: np.random.Generator, radius: float, side: int = 7) -> np.ndarray:
    """side x side cells of one family of shapes, turned and shifted at random."""
    pitch = int(3.2 * radius)
    labels = np.zeros((pitch * side, pitch * side), np.uint16)
    rows, columns = np.mgrid[:pitch, :pitch]
    for k in range(side * side):
        x, y = pitch / 2 + rng.uniform(-0.5, 0.5, 2)
        angle = np.arctan2(rows - y, columns - x) - rng.uniform(0, 2 * np.pi)
        two, three = 0.08 + 0.06 * (k % 7) / 6, 0.05 * (k % 5) / 4
        edge = radius * (1 + two * np.cos(2 * angle) + three * np.cos(3 * angle + 1))
        inside = np.hypot(rows - y, columns - x) <= edge
        corner = pitch * (k // side), pitch * (k % side)
        labels[corner[0] : corner[0] + pitch, corner[1] : corner[1] + pitch][inside] = k + 1
    return labels


def test_shapes_that_only_shrink_keep_their_index() -> None:
    # Eight stacks in which the radius falls from 16 to 9 px; the shapes are the same.
    rng = np.random.default_rng(1)
    means = []
    for radius in np.linspace(16, 9, 8):
        frames = np.stack([shaped_cells(rng, radius) for _ in range(2)])
        stack = LabelStack.from_array(frames, pixel_size=0.65, frame_interval=10.0)
        found = observe(measure_cells(stack), only=["shape_index"]).summary["shape_index"]
        assert found["n"] == 2 * 49
        means.append(found["mean"])
    assert np.ptp(means) / np.mean(means) < 0.003, means

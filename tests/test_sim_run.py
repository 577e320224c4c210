"""Runs: resuming, streaming, failing, and what they become as tracks."""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pandas as pd
import pytest

from cellquant.errors import InputError
from cellquant.observables import observe
from cellquant.pipeline import observe_source
from cellquant.sim import Scene, SimulationFailure, open_run, simulate
from cellquant.sim import run as run_module
from cellquant.sim.noise import BrownianTree
from cellquant.sim.rows import RunRows
from cellquant.tables import REDUCED, TRACK_COLUMNS

SMALL = Scene(n_cells=9, phi=0.9)
DRAWN_OUT = Scene(n_cells=9, phi=1.0, v0=0.3, eta=0.0, mu_ab=1.0)  # fast cells without tension


def same(a, b):
    for name in ("time", "position", "polarity", "modes"):
        assert getattr(a, name).tobytes() == getattr(b, name).tobytes(), name


def test_frames_have_the_layout_of_the_contract(tmp_path):
    run = simulate(SMALL, duration=3, transient=1, dt=0.02, output=tmp_path / "run.zarr")
    assert run.status == "complete"
    assert run.time == pytest.approx([0, 1, 2, 3])
    assert run.position.shape == (4, 9, 2)
    assert run.polarity.shape == (4, 9)
    assert run.modes.shape == (4, 9, 2, 5)
    assert run.radius.shape == (9,)
    assert len(run.box) == 2
    assert run.settings["dt"] == pytest.approx(0.02)
    assert Scene.from_dict(run.scene.to_dict()) == SMALL
    assert run.work["evaluations"] > 0


def test_the_usual_step_is_shorter_for_fast_cells():
    for v0, usual in ((0.0, 0.1), (0.03, 0.1), (0.06, 0.05), (0.3, 0.01)):
        run = simulate(Scene(n_cells=4, phi=0.6, v0=v0), duration=0.2, save_every=0.2)
        assert run.settings["dt"] == pytest.approx(usual)


def test_interrupted_run_resumes_bitwise(tmp_path, monkeypatch):
    whole = simulate(SMALL, duration=6, transient=1, dt=0.02, output=tmp_path / "whole.zarr")
    monkeypatch.setattr(run_module, "CHECKPOINT_EVERY", 0.0)

    class Stop(Exception):
        pass

    def stop_at(limit):
        def progress(done, total):
            if done == limit:
                raise Stop

        return progress

    for limit in (1, 2, 4, 6):
        with pytest.raises(Stop):
            simulate(
                SMALL, duration=6, transient=1, dt=0.02, output=tmp_path / "parts.zarr",
                progress=stop_at(limit),
            )  # fmt: skip
        assert open_run(tmp_path / "parts.zarr").status == "running"
    parts = simulate(SMALL, duration=6, transient=1, dt=0.02, output=tmp_path / "parts.zarr")
    assert parts.status == "complete"
    same(whole, parts)
    again = simulate(SMALL, duration=6, transient=1, dt=0.02, output=tmp_path / "parts.zarr")
    same(whole, again)
    same(whole, simulate(SMALL, duration=6, transient=1, dt=0.02))


@pytest.mark.slow
def test_killed_run_resumes_bitwise(tmp_path):
    code = (
        "import sys; from cellquant.sim import Scene, simulate; "
        "import cellquant.sim.run as r; r.CHECKPOINT_EVERY = 0.0; "
        "simulate(Scene(n_cells=9, phi=0.9), duration=400, dt=0.01, output=sys.argv[1])"
    )
    path = tmp_path / "run.zarr"
    for _ in range(3):
        process = subprocess.Popen([sys.executable, "-c", code, str(path)])
        start = len(open_run(path).time) if path.exists() else 0
        for _ in range(600):
            time.sleep(0.1)
            if (path / "checkpoint.npz").exists() and open_run(path).n_frames > start + 5:
                break
        process.send_signal(signal.SIGKILL)
        process.wait()
        assert open_run(path).to_tracks().table["frame"].max() > start
    resumed = simulate(Scene(n_cells=9, phi=0.9), duration=400, dt=0.01, output=path)
    same(resumed, simulate(Scene(n_cells=9, phi=0.9), duration=400, dt=0.01))


@pytest.mark.slow
def test_threads_do_not_change_the_run(tmp_path):
    code = (
        "import sys; from cellquant.sim import Scene, simulate; "
        "simulate(Scene(n_cells=100), duration=2, dt=0.02, output=sys.argv[1])"
    )
    for threads in (1, 2):
        environment = {**os.environ, "NUMBA_NUM_THREADS": str(threads)}
        command = [sys.executable, "-c", code, str(tmp_path / f"{threads}.zarr")]
        subprocess.run(command, check=True, env=environment)
    same(open_run(tmp_path / "1.zarr"), open_run(tmp_path / "2.zarr"))


def test_steps_without_linear_algebra_resume_bitwise(tmp_path, monkeypatch):
    """The stiffness seen last is no part of the checkpoint."""
    scene = Scene(n_cells=16)
    whole = simulate(scene, duration=0.6, dt=0.005, save_every=0.2)
    monkeypatch.setattr(run_module, "CHECKPOINT_EVERY", 0.0)

    def stop(done, total):
        raise KeyboardInterrupt

    path = tmp_path / "run.zarr"
    with pytest.raises(KeyboardInterrupt):
        simulate(scene, duration=0.6, dt=0.005, save_every=0.2, output=path, progress=stop)
    same(whole, simulate(scene, duration=0.6, dt=0.005, save_every=0.2, output=path))


def test_other_settings_are_not_mixed_into_a_run(tmp_path):
    simulate(SMALL, duration=1, dt=0.02, output=tmp_path / "run.zarr")
    with pytest.raises(InputError, match="another v0"):
        simulate(SMALL.replace(v0=0.1), duration=1, dt=0.02, output=tmp_path / "run.zarr")
    with pytest.raises(InputError, match="another duration"):
        simulate(SMALL, duration=2, dt=0.02, output=tmp_path / "run.zarr")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "file").write_text("mine")
    with pytest.raises(InputError, match="is no run"):
        simulate(SMALL, duration=1, output=tmp_path / "other")
    with pytest.raises(InputError, match="does not exist"):
        open_run(tmp_path / "absent.zarr")
    with pytest.raises(InputError):
        open_run(tmp_path / "other")


@pytest.mark.parametrize(
    "options",
    [
        {"duration": 0.0}, {"duration": np.inf}, {"duration": 1.0, "transient": -1.0},
        {"duration": 1.0, "dt": 0.0}, {"duration": 1.0, "save_every": -2.0},
        {"duration": 1.0, "integrator": "magic"}, {"duration": 1.0, "contact": "soft"},
        {"duration": 1.0, "contact": "quadrature", "points": 7},
        {"duration": 1.0, "integrator": "euler", "tolerance": 1e-3},
    ],
)  # fmt: skip
def test_wrong_options_are_refused(options):
    with pytest.raises(InputError):
        simulate(SMALL, **options)


def test_too_long_a_step_stops_with_the_partial_run(tmp_path):
    scene = Scene(n_cells=36)
    with pytest.raises(SimulationFailure, match=r"smaller dt") as caught:
        simulate(scene, duration=50, integrator="euler", dt=0.2, output=tmp_path / "run.zarr")
    failure = caught.value
    assert failure.run.n_frames >= 1
    assert failure.step > 0
    stored = open_run(tmp_path / "run.zarr")
    assert stored.status == "failed"
    assert stored.failure["remedy"] == failure.remedy
    assert np.isfinite(stored.position).all()


def test_tracks_carry_the_true_contours():
    run = simulate(Scene(n_cells=16), duration=2, dt=0.02)
    tracks = run.to_tracks()
    table = tracks.table
    assert tracks.units == REDUCED
    assert tracks.box == run.box
    assert tracks.area == pytest.approx(np.prod(run.box))
    assert tracks.frame_interval == 1.0
    assert len(table) == 3 * 16
    assert table["area"].to_numpy() == pytest.approx(np.repeat(np.pi * run.radius**2, 3))
    assert (table["shape_index"] >= 2 * np.sqrt(np.pi) - 1e-12).all()
    first = table[table["track_id"] == 5]
    assert first[["x", "y"]].to_numpy() == pytest.approx(run.position[:, 4])
    assert first["time"].to_numpy() == pytest.approx(run.time)
    assert 3 < table["n_neighbours"].mean() <= 6
    assert list(table.columns) == list(TRACK_COLUMNS)
    for columns in (["frame", "area", "track_id"], ["y", "aspect_ratio"], ["n_neighbours"]):
        part = run.to_tracks(columns=columns).table
        assert set(part.columns) == set(columns)
        pd.testing.assert_frame_equal(part, table[part.columns])


def test_a_run_in_pieces_gives_the_bytes_of_its_table(monkeypatch, tmp_path):
    path = tmp_path / "run.zarr"
    run = simulate(Scene(n_cells=23), duration=10, dt=0.1, save_every=0.25, output=path)
    observe(run.to_tracks()).write(tmp_path / "table")
    frames = [slice(start, min(start + 7, 41)) for start in range(0, 41, 7)]
    monkeypatch.setattr("cellquant.sim.archive.Run.stretches", lambda run: iter(frames))
    monkeypatch.setattr("cellquant.rows.PIECE", 100)
    pieces = [set(p["track_id"].tolist()) for p in RunRows(run).pieces("x")]
    assert len(pieces) > 8
    assert sum(map(len, pieces)) == 23
    observe_source(path, tmp_path / "pieces")
    for file in (tmp_path / "table").iterdir():
        assert file.read_bytes() == (tmp_path / "pieces" / file.name).read_bytes(), file.name


@pytest.mark.parametrize("only", [["msd"], ["density", "structure_factor"]])
def test_motion_of_a_run_measures_no_contour(only, monkeypatch):
    run = simulate(Scene(n_cells=16), duration=2, dt=0.02)
    expected = observe(run.to_tracks(), only=only)

    def refuse(*args):
        raise AssertionError("a contour was measured that no output shows")

    monkeypatch.setattr("cellquant.sim.rows.measure_shapes", refuse)
    monkeypatch.setattr("cellquant.sim.archive.Run.count_neighbours", refuse)
    assert observe(run, only=only).summary == expected.summary
    with pytest.raises(AssertionError, match="no output shows"):
        observe(run, only=["shape_index"])


def test_brownian_tree_is_one_path_at_every_depth():
    tree = BrownianTree(3, 2000, 0.8)
    top_w, top_h = (x.copy() for x in tree.level(5, 0))
    for depth in (1, 3, 6):
        w, h = tree.level(5, depth)
        length = 0.8 / 2**depth
        assert w.sum(axis=0) == pytest.approx(top_w[0], abs=1e-12)
        # Area of the root from the parts: H T = sum over parts of (W_start + w/2 + h) dt - W T/2.
        start = np.cumsum(w, axis=0) - w
        area = np.sum((start + 0.5 * w + h) * length, axis=0) / 0.8 - 0.5 * top_w[0]
        assert area == pytest.approx(top_h[0], abs=1e-12)
        assert w.var() == pytest.approx(length, rel=0.1)
        assert h.var() == pytest.approx(length / 12, rel=0.1)
    tree.level(6, 2)
    again = BrownianTree(3, 2000, 0.8)
    assert np.array_equal(again.level(5, 6)[0], tree.level(5, 6)[0])


def test_free_cell_walks_persistently():
    """MSD of an active Brownian particle: 2 v0^2/D^2 (D t - 1 + exp(-D t))."""
    scene = Scene(n_cells=400, phi=0.0005, v0=0.3, D_r=0.5, mu_theta=0.0, modes=1, eta=0.0)
    run = simulate(scene, duration=8, dt=0.02)
    moved = run.position[-1] - run.position[0]
    squares = np.sum(moved**2, axis=1)
    x = 0.5 * 8
    expected = 2 * (0.3 / 0.5) ** 2 * (x - 1 + np.exp(-x))
    assert squares.mean() == pytest.approx(expected, abs=4 * squares.std() / 20)


def test_shape_modes_relax_as_linear_theory_says():
    """d a_n/dt = -mu_ab eta pi R0 (n^2 - 1) a_n for a nearly round cell at constant area."""
    scene = Scene(n_cells=1, phi=0.05, v0=0.0, D_r=0.0, eta=0.2, mu_ab=0.5, polydispersity=0.0)
    from cellquant.sim.contacts import Layer
    from cellquant.sim.initial import initial_state

    state, radius, box = initial_state(scene)
    layer = Layer(scene, radius, box)
    out = np.empty_like(state)
    for mode in range(2, 7):
        for column in (1 + mode, 6 + mode):
            moved = state.copy()
            moved[0, column] = 1e-5
            layer.velocity(moved, out)
            rate = 0.5 * 0.2 * np.pi * 0.5 * (mode**2 - 1)
            assert out[0, column] == pytest.approx(-rate * 1e-5, rel=1e-5)


def test_passive_layer_never_gains_energy():
    from cellquant.sim.contacts import Layer

    scene = Scene(n_cells=36, v0=0.0, D_r=0.0, phi=1.0)
    run = simulate(scene, duration=10, dt=0.005, save_every=0.25)
    layer = Layer(scene, run.radius, np.array(run.box))
    energy = [layer.energies(run.state(t)).sum() for t in range(run.n_frames)]
    assert (np.diff(energy) < 1e-9).all()
    assert energy[-1] < 0.9 * energy[0]


def test_two_cells_head_on_stop_where_push_and_drive_balance():
    """Two rigid discs that drive against each other rest at the chord c = v0 / (mu_r k)."""
    scene = Scene(
        n_cells=2, box=(10, 10), radii=(0.5, 0.5), positions=((4, 5), (5.2, 5)),
        polarities=(0.0, np.pi), v0=0.2, D_r=0.0, mu_theta=0.0, modes=1, eta=0.0,
    )  # fmt: skip
    run = simulate(scene, duration=20, dt=0.01)
    distance = np.linalg.norm(run.position[-1, 1] - run.position[-1, 0])
    assert distance == pytest.approx(2 * np.sqrt(0.25 - 0.1**2), rel=1e-6)


def test_adaptive_run_keeps_its_path_and_resumes(tmp_path, monkeypatch):
    scene = Scene(n_cells=16)
    whole = simulate(scene, duration=4, tolerance=2e-3)
    assert whole.settings["integrator"] == "adaptive"
    fine = simulate(scene, duration=4, tolerance=1e-4)
    assert fine.work["steps"] > 2 * whole.work["steps"]
    assert np.sqrt(np.mean((fine.position[-1] - whole.position[-1]) ** 2)) < 1e-2
    monkeypatch.setattr(run_module, "CHECKPOINT_EVERY", 0.0)

    class Stop(Exception):
        pass

    def stop(done, total):
        if done == 2:
            raise Stop

    with pytest.raises(Stop):
        simulate(scene, duration=4, tolerance=2e-3, output=tmp_path / "run.zarr", progress=stop)
    same(whole, simulate(scene, duration=4, tolerance=2e-3, output=tmp_path / "run.zarr"))


@pytest.mark.slow
def test_extreme_scenes_end_with_an_answer_or_a_refusal(monkeypatch):
    """Also writes the table of docs/accuracy_simulation.md anew."""
    from pathlib import Path

    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "benchmarks"))
    import extreme_scenes
    import simulation_report

    for name, found in extreme_scenes.main().items():
        if "error" in found:
            # From these two states every small error grows.
            steep = name in ("sixteen almost on top", "box of one cell width")
            assert found["error"] < (1.0 if steep else 0.1), name
            assert found.get("adaptive_error", 0.0) < (1.0 if steep else 0.02), name
            assert found["reference_error"] < (0.3 if steep else 1e-3), name
        assert found["outcome"] == "solved" or ";" in found["outcome"], name
        assert 3.5 < found.get("p", 3.6) < 6.0, name
    simulation_report.main()


def test_a_step_that_fails_is_taken_in_parts_on_the_same_path(monkeypatch):
    from cellquant.sim.contacts import Layer
    from cellquant.sim.initial import initial_state
    from cellquant.sim.integrators import METHODS, Euler, Method

    class Fragile(Euler):
        def step(self, state, h, w, area):
            if h > 0.015:
                state += 1.0  # what a failing method leaves behind must not matter
                raise SimulationFailure("too long", "none")
            super().step(state, h, w, area)

    monkeypatch.setitem(METHODS, "fragile", Method(Fragile, 0.02))
    run = simulate(SMALL, duration=2, integrator="fragile", dt=0.02)
    assert run.work["repaired"] == run.work["rejected"] == run.work["steps"] == 100
    state, radius, box = initial_state(SMALL)
    euler = Euler(Layer(SMALL, radius, box))
    tree = BrownianTree(SMALL.seed, 9, 0.08)
    for root in range(25):
        for w, area in zip(*tree.level(root, 3), strict=True):
            euler.step(state, 0.01, w, area)
    assert np.array_equal(run.state(-1), state)

    class Broken(Euler):
        def step(self, state, h, w, area):
            raise SimulationFailure("broken", "mend it", cell=3)

    monkeypatch.setitem(METHODS, "broken", Method(Broken, 0.02))
    with pytest.raises(SimulationFailure, match=r"broken even at a step of 0\.0003") as caught:
        simulate(SMALL, duration=2, integrator="broken", dt=0.02)
    assert caught.value.cell == 3
    assert caught.value.remedy == "mend it"


def test_a_run_goes_on_past_a_pinched_cell_and_says_so(tmp_path, monkeypatch):
    from cellquant.cli.text import run_lines
    from cellquant.sim.shapes import pinched

    monkeypatch.setattr(run_module, "CHECKPOINT_EVERY", 0.0)

    class Stop(Exception):
        pass

    def stop(done, total):
        if done == 11:
            raise Stop

    path = tmp_path / "run.zarr"
    with pytest.raises(Stop):
        simulate(DRAWN_OUT, duration=12, output=path, progress=stop)
    run = simulate(DRAWN_OUT, duration=12, output=path)
    same(run, simulate(DRAWN_OUT, duration=12))
    closed = [pinched(run.modes[t]).sum() for t in range(13)]
    assert sum(closed) > 0
    assert run.work["pinched_cells"] >= 1
    assert run.work["pinched_share"] == pytest.approx(sum(closed) / 12 / 9)
    assert any(line.startswith("pinched: ") for line in run_lines(run))


def test_a_run_goes_on_where_the_closed_form_of_a0_ends():
    """Cells drawn out until sum(a_n^2 + b_n^2) / 2 > 1 keep their area and a finite length."""
    run = simulate(DRAWN_OUT, duration=40)
    assert run.n_frames == 41
    assert (0.5 * np.sum(run.modes[:] ** 2, axis=(2, 3))).max() > 1.0
    assert run.mean_shape_index().max() < 8.0


def test_scene_files_give_box_radii_and_initial_state():
    from cellquant.config import SceneConfig, validate

    def scene(**content):
        return Scene.from_config(validate(content, SceneConfig, where="scene.toml"))

    run = simulate(scene(box=[3.0, 2.0], radii=[0.5, 0.4, 0.6], initial="random"), duration=1)
    assert run.box == (3.0, 2.0)
    assert run.radius == pytest.approx([0.5, 0.4, 0.6])
    assert run.phi == pytest.approx(np.pi * (0.25 + 0.16 + 0.36) / 6)
    placed = scene(phi=0.8, positions=[[1, 1], [2, 1]], polarities=[0, 1.5])
    assert placed.n_cells == 2
    assert placed.positions == ((1.0, 1.0), (2.0, 1.0))
    assert placed.polarities == (0.0, 1.5)
    for wrong, match in (
        ({"phi": 0.9, "box": [3, 2]}, "box and phi"),
        ({"radii": [0.5, 0.5], "polydispersity": 0.1}, "radii and polydispersity"),
        ({"radii": [0.5, 0.5], "cells": 3}, "radii must have one entry per cell"),
        ({"positions": [[0, 0], [1, 1]], "initial": "random"}, "positions and initial"),
        ({"box": [1.0, 1.0], "cells": 9}, "7.07 times its area"),
        ({"radii": [0.5, -0.5]}, "radii"),
        ({"shapes": [[0.1, 0.2]], "modes": 3}, "shapes must be rows of 4 finite numbers"),
        ({"shapes": [[0.1] * 10, [1e9] * 10]}, "shapes must be rows of 10 finite numbers"),
        ({"shapes": [[0.1] * 10], "cells": 2}, "shapes must have one entry per cell"),
    ):
        with pytest.raises(InputError, match=match):
            scene(**wrong)


def test_a_run_goes_on_from_the_state_of_another():
    first = simulate(SMALL, duration=4)
    state = first.state(-1)
    scene = SMALL.replace(
        radii=first.radius, box=first.box, positions=state[:, :2], polarities=state[:, 2],
        shapes=state[:, 3:], seed=2, v0=0.01,
    )  # fmt: skip
    later = simulate(scene, duration=2, integrator="euler", contact="quadrature")
    assert np.array_equal(later.state(0), state)
    assert not np.array_equal(later.state(-1), state)
    assert Scene.from_dict(scene.to_dict()) == scene


def test_a_growing_run_is_read_as_a_whole(tmp_path, monkeypatch):
    """What is written after a run was opened does not mix into what is read of it."""
    monkeypatch.setattr(run_module, "CHECKPOINT_EVERY", 0.0)
    path, seen = tmp_path / "run.zarr", []

    def look(done, total):
        if done == 3:
            seen.append(open_run(path))
            assert seen[0].n_frames == 2
        elif done == 5:
            assert open_run(path).n_frames == 4
            assert seen[0].to_tracks().table["frame"].max() == 1
            assert len(seen[0].position) == len(seen[0].modes) == seen[0].n_frames == 2

    simulate(SMALL, duration=6, dt=0.02, output=path, progress=look)
    assert len(seen) == 1


def test_drift_of_the_shape_index_is_stated(tmp_path):
    run = simulate(Scene(n_cells=16), duration=12, save_every=0.25)
    found = run.stationarity()
    assert found.drift > 2 * found.std_error > 0  # shapes still leave the round start
    assert not found.stationary
    assert run.stationarity(start=9).drift == pytest.approx(found.drift)  # the last 40 frames
    series = run.mean_shape_index()
    assert series == pytest.approx(
        run.to_tracks().table.groupby("frame")["shape_index"].mean().to_numpy(), rel=1e-12
    )
    assert found.drift == pytest.approx(series[29:].mean() - series[9:29].mean(), abs=1e-12)
    stated = observe(run, only=["shape_index"]).summary["stationarity"]
    assert stated["stationary"] is False
    assert stated["drift"] == pytest.approx(found.drift, rel=1e-9)
    with pytest.raises(InputError, match="needs 40 frames"):
        run.stationarity(start=20)

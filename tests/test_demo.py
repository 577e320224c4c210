"""The demo: the embedded recording, and the closed loop whose truth is known."""

import json
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from cellquant.closed_loop import LENGTH, TIME, close_loop, closed_loop_table
from cellquant.config import SceneConfig
from cellquant.demo import run_demo


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run_demo(tmp_path_factory.mktemp("demo") / "out", seed=2).parent


def test_the_demo_writes_one_page_without_links_to_the_network(demo: Path) -> None:
    page = (demo / "report.html").read_text(encoding="utf-8")
    assert len(page) < 3_000_000
    assert page.count("<svg") >= 8
    assert not re.findall(r"(?:src|href)=[\"']https?://", page)
    assert "closed loop" in page


def test_what_the_demo_says_of_the_recording_is_true(demo: Path) -> None:
    inspection = json.loads((demo / "recording" / "inspection.json").read_text())
    assert (inspection["n_frames"], inspection["ids"]) == (37, "per frame")
    summary = json.loads((demo / "recording" / "summary.json").read_text())
    assert (summary["length_unit"], summary["time_unit"]) == ("px", "frame")
    cells = pd.read_parquet(demo / "recording" / "cells.parquet")
    assert cells.groupby("frame").size().between(55, 70).all()
    assert (
        summary["n_tracks"]
        == pd.read_parquet(demo / "recording" / "tracks.parquet")["track_id"].nunique()
    )


def test_the_closed_loop_recovers_the_truth(demo: Path) -> None:
    rows = {
        row["quantity"]: row
        for row in json.loads((demo / "layer" / "closed_loop.json").read_text())
    }
    assert abs(rows["mean shape index"]["error"]) < 0.006
    assert abs(rows["mean diameter"]["error"]) < 0.01
    assert abs(rows["mean speed"]["error"]) < 0.05
    # A relaxation time of one small layer is known to its standard errors, not better.
    tau = rows["relaxation time"]
    spread = np.hypot(tau["truth_std_error"], tau["measured_std_error"])
    assert abs(tau["measured"] - tau["truth"]) < 3 * spread


def test_the_table_converts_units_and_splits_the_error() -> None:
    def summary(shape: float, diameter: float, tau: float | None, speed: float) -> dict:
        return {
            "shape_index": {"mean": shape, "std_error": 0.01},
            "wave_number": {"mean_diameter": diameter, "mean_diameter_std_error": 0.1},
            "tau_alpha": {"value": tau, "std_error": None},
            "speed": {"mean": speed, "std_error": 0.0},
        }

    table = closed_loop_table(
        {
            "truth": summary(3.8, 1.0, 100.0, 0.02),
            "field": summary(3.8, LENGTH, None, 0.02 * LENGTH / TIME),
            "found": summary(3.838, 1.02 * LENGTH, 110.0 * TIME, 0.019 * LENGTH / TIME),
        }
    ).set_index("quantity")
    assert table["error"].to_dict() == pytest.approx(
        {
            "mean shape index": 0.01,
            "mean diameter": 0.02,
            "relaxation time": 0.1,
            "mean speed": -0.05,
        }
    )
    assert table.loc["mean diameter", "from_field"] == pytest.approx(0.0)
    assert np.isnan(table.loc["relaxation time", "from_masks"])


@pytest.mark.slow
def test_a_larger_layer_is_recovered_closely(tmp_path: Path) -> None:
    scene = SceneConfig(
        cells=400,
        phi=0.92,
        v0=0.07,
        eta=0.01,
        rotational_diffusion=0.02,
        transient=100,
        duration=300,
        save_every=2.5,
        seed=1,
    )
    table = close_loop(scene, tmp_path).table.set_index("quantity")
    assert abs(table.loc["mean shape index", "error"]) < 0.005
    assert abs(table.loc["mean diameter", "error"]) < 0.01
    assert abs(table.loc["relaxation time", "error"]) < 0.1

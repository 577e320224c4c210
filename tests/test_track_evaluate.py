"""Scores against a truth: perfect tracks, known mistakes, and what mistakes do to the physics."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from cellquant.errors import InputError
from cellquant.io import read_labels
from cellquant.segment import measure_cells
from cellquant.tables import PIXEL, Tracks
from cellquant.track.consequences import dynamics_error
from cellquant.track.evaluate import edges, evaluate, match_cells, read_truth, score_tables


def tracks_of(table: pd.DataFrame) -> Tracks:
    table = table.assign(
        area=1.0,
        perimeter=4.0,
        shape_index=3.9,
        aspect_ratio=1.0,
        orientation=0.0,
        touches_border=False,
        n_neighbours=6,
        time=table["frame"].astype(float),
    )
    return Tracks(table, PIXEL, 1.0, 1e6)


@pytest.fixture(scope="module")
def truth(recordings: Path) -> pd.DataFrame:
    return read_truth(recordings / "epidermis_area1")


def test_truth_scores_one(recordings: Path, truth: pd.DataFrame) -> None:
    scores = evaluate(tracks_of(truth), recordings / "epidermis_area1")
    assert scores.edge_f1 == scores.division_f1 == scores.lnk == scores.tra == scores.idf1 == 1.0
    assert scores.n_matched == len(truth)
    assert scores.n_true_divisions == 335


def test_cut_tracks_lose_exactly_their_edges(truth: pd.DataFrame) -> None:
    """Tracks cut in two keep their precision, and their recall is the share of links kept."""
    with_links = truth.assign(
        track_id=truth["track_id"] * 10 + truth["frame"] // 8, parent_track_id=0
    )
    scores = score_tables(with_links, truth)
    source, _ = edges(with_links.sort_values(["track_id", "frame"], ignore_index=True))
    assert scores.edge_precision == 1.0
    assert scores.edge_recall == pytest.approx(len(source) / scores.n_true_edges)
    assert scores.n_divisions == 0


def test_cells_match_by_place_not_by_label(truth: pd.DataFrame) -> None:
    mixed = truth.sample(frac=1.0, random_state=0).assign(label=1).reset_index(drop=True)
    true_rows, rows = match_cells(truth, mixed)
    assert len(rows) == len(truth)
    assert np.array_equal(truth["x"].to_numpy()[true_rows], mixed["x"].to_numpy()[rows])


def test_folder_without_truth_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="man_track"):
        read_truth(tmp_path)


def test_physical_tracks_need_their_pixel_size(recordings: Path, truth: pd.DataFrame) -> None:
    from dataclasses import replace

    from cellquant.tables import PHYSICAL

    with pytest.raises(InputError, match="pixel size"):
        evaluate(replace(tracks_of(truth), units=PHYSICAL), recordings / "epidermis_area1")


def test_true_links_make_no_error_in_the_dynamics(recordings: Path) -> None:
    folder = recordings / "epidermis_area1"
    cells = measure_cells(read_labels(folder / "TRA", units="pixel"))
    table = cells.table.assign(
        track_id=cells.table["label"], parent_track_id=0, time=cells.table["frame"] * 1.0
    ).sort_values(["track_id", "frame"], ignore_index=True)
    error = dynamics_error(Tracks(table, PIXEL, 1.0, 460.0**2), folder, min_points=4, window=15)
    assert np.allclose(error.table["msd_relative_error"], 0.0, atol=1e-12)
    assert np.allclose(error.table["scattering_error"], 0.0, atol=1e-12)
    assert error.tau_alpha == error.true_tau_alpha
    assert error.reason is None
    assert error.as_lines()[0].startswith("error of MSD from linking: +0 % at most")


def test_wrong_links_change_the_dynamics_and_short_movies_say_why(
    recordings: Path, truth: pd.DataFrame
) -> None:
    """Tracks that change places half way move too far: MSD too great, F_s too small."""
    folder = recordings / "epidermis_area1"
    late = truth["frame"] >= 7
    table = truth.assign(track_id=truth["track_id"].where(~late, truth["track_id"] + 1))
    table["parent_track_id"] = 0
    table = table.drop_duplicates(["track_id", "frame"]).sort_values(
        ["track_id", "frame"], ignore_index=True
    )
    wrong = tracks_of(table)
    error = dynamics_error(wrong, folder, min_points=4, window=15)
    assert error.table["msd_relative_error"].iloc[0] > 0.5
    assert error.table["scattering_error"].iloc[0] < 0.0
    assert set(error.as_dict()) > {"msd_relative_error", "scattering_error", "true_tau_alpha"}
    short = dynamics_error(wrong, folder)
    assert short.table.empty
    assert "24 consecutive points" in short.as_lines()[0]

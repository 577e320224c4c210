"""Smoothing, drift and retention against loops written from their definitions."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cellquant.errors import InputError
from cellquant.observables import observe, remove_drift, retain, smooth_tracks
from cellquant.tables import Tracks
from observables_examples import brownian, tracks_of, with_gaps


def naive_average(x: np.ndarray, half: int) -> np.ndarray:
    """Moving average of one run of consecutive frames, shrinking towards the ends."""
    out = np.empty_like(x)
    for i in range(x.size):
        h = min(half, i, x.size - 1 - i)
        out[i] = x[i - h : i + h + 1].mean()
    return out


@given(seed=st.integers(0, 10**6), points=st.sampled_from([1, 3, 5, 9]))
@settings(deadline=None, max_examples=25)
def test_smoothing_is_the_average_of_each_run(seed: int, points: int) -> None:
    rng = np.random.default_rng(seed)
    tracks = with_gaps(brownian(rng, 4, 30), rng, 0.15)
    found = smooth_tracks(tracks, points).table
    for _, rows in tracks.table.groupby("track_id"):
        run = (rows["frame"].diff() != 1).cumsum()
        for _, part in rows.groupby(run):
            expected = naive_average(part["x"].to_numpy(), points // 2)
            np.testing.assert_allclose(found["x"].loc[part.index], expected, atol=1e-12)


def test_smoothing_leaves_the_ends_and_the_source_alone() -> None:
    tracks = brownian(np.random.default_rng(0), 3, 12)
    before = tracks.table.copy()
    smooth = smooth_tracks(tracks)
    pd.testing.assert_frame_equal(tracks.table, before)
    assert smooth.smoothing == 5
    ends = [0, 11, 12, 23, 24, 35]
    np.testing.assert_array_equal(smooth.table["x"].iloc[ends], before["x"].iloc[ends])


@pytest.mark.parametrize("points", [0, 2, -5])
def test_smoothing_refuses_even_widths(points: int) -> None:
    with pytest.raises(ValueError, match="odd"):
        smooth_tracks(brownian(np.random.default_rng(0), 2, 9), points)


def test_smoothing_twice_is_refused() -> None:
    once = smooth_tracks(brownian(np.random.default_rng(0), 2, 9))
    with pytest.raises(ValueError, match="twice"):
        smooth_tracks(once)


def test_a_position_that_is_not_a_number_ends_a_run() -> None:
    tracks = brownian(np.random.default_rng(1), 1, 11)
    tracks.table.loc[5, "x"] = np.nan
    found = smooth_tracks(tracks).table["x"].to_numpy()
    x = tracks.table["x"].to_numpy()
    np.testing.assert_allclose(found[:5], naive_average(x[:5], 2))
    np.testing.assert_allclose(found[6:], naive_average(x[6:], 2))
    assert np.isnan(found[5])


def test_drift_of_a_rigid_translation_is_removed_exactly() -> None:
    rng = np.random.default_rng(2)
    still = rng.uniform(0, 9, (20, 1, 2))
    path = np.cumsum(rng.normal(0, 1, (1, 30, 2)), axis=1)
    path[:, 0] = 0
    found = remove_drift(tracks_of(still + path))
    moved = found.table.groupby("track_id")[["x", "y"]].agg(np.ptp).to_numpy()
    assert moved.max() < 1e-12
    assert found.provenance["drift"] == {"removed": True, "steps_kept": 0, "min_cells": 8}


def test_cells_that_enter_and_leave_fake_no_drift() -> None:
    # Cells stand still; those on the right appear late, those on the left leave early, so that
    # the mean position wanders by half the field.
    rng = np.random.default_rng(3)
    place = np.repeat(rng.uniform(0, 100, (60, 1, 2)), 40, axis=1)
    left = place[:, 0, 0] < 50
    place[left, 25:] = np.nan
    place[~left, :15] = np.nan
    found = remove_drift(tracks_of(place))
    np.testing.assert_allclose(found.table[["x", "y"]], tracks_of(place).table[["x", "y"]])


def test_drift_uses_the_steps_of_common_cells() -> None:
    rng = np.random.default_rng(4)
    tracks = with_gaps(brownian(rng, 30, 20), rng, 0.3)
    found = remove_drift(tracks).table
    wide = tracks.table.pivot(index="frame", columns="track_id", values="x")
    drift = wide.diff().mean(axis=1).fillna(0).cumsum()
    expected = tracks.table["x"].to_numpy() - drift.loc[tracks.table["frame"]].to_numpy()
    np.testing.assert_allclose(found["x"], expected, atol=1e-12)


def test_few_cells_keep_their_motion() -> None:
    tracks = brownian(np.random.default_rng(5), 3, 10)
    found = remove_drift(tracks)
    pd.testing.assert_frame_equal(found.table, tracks.table)
    assert found.provenance["drift"]["removed"] is False
    assert found.provenance["drift"]["steps_kept"] == 9


def test_retention_counts_consecutive_points() -> None:
    place = np.zeros((3, 50, 2))
    place[1, 23] = np.nan  # runs of 23 and 26
    place[2, ::20] = np.nan  # runs of at most 19
    kept = retain(tracks_of(place), 24).table["track_id"].unique()
    assert kept.tolist() == [1, 2]
    assert retain(tracks_of(place), 51).n_tracks == 0
    with pytest.raises(ValueError, match="min_points"):
        retain(tracks_of(place), 0)


def test_rows_in_any_order_give_the_same_tracks() -> None:
    rng = np.random.default_rng(6)
    tracks = with_gaps(brownian(rng, 12, 30), rng)
    shuffled = Tracks(
        tracks.table.sample(frac=1, random_state=1), tracks.units, 1.0, tracks.area, None
    )
    for step in (smooth_tracks, remove_drift, retain):
        pd.testing.assert_frame_equal(step(shuffled).table, step(tracks).table)


def test_two_positions_in_one_frame_are_refused() -> None:
    tracks = brownian(np.random.default_rng(7), 2, 5)
    table = pd.concat([tracks.table, tracks.table.iloc[[7]]])
    twice = Tracks(table, tracks.units, 1.0, tracks.area, None)
    for step in (smooth_tracks, remove_drift, retain):
        with pytest.raises(InputError, match="track 2 has 2 rows in frame 2"):
            step(twice)


def test_cut_cells_give_no_motion() -> None:
    rng = np.random.default_rng(8)
    step = rng.normal(0, 0.1, (60, 40, 2))
    step[:20] *= 0.5  # what is seen of the cells at the border moves less
    border = np.repeat((np.arange(60) < 20)[:, None], 40, axis=1)
    tracks = tracks_of(np.cumsum(step, axis=1), touches_border=border)
    options = {"only": ["msd"], "drift": False, "smoothing": 1, "lags": [1]}
    whole = observe(tracks, **options)
    inner = observe(replace(tracks, table=tracks.table[~tracks.table["touches_border"]]), **options)
    pd.testing.assert_frame_equal(whole.tables["msd"], inner.tables["msd"])
    assert whole.summary["processing"]["cut_cells_left_out"] == 20 * 40
    kept = observe(tracks, keep_cut_cells=True, **options)
    expected = np.mean(np.diff(np.cumsum(step, axis=1), axis=1) ** 2) * 2
    assert kept.tables["msd"]["value"][0] == pytest.approx(expected)
    assert whole.tables["msd"]["value"][0] == pytest.approx(0.02, rel=0.1)
    alone = observe(tracks_of(np.cumsum(step, axis=1), touches_border=True), **options)
    assert "away from the border" in alone.summary["msd"]["reason"]

"""Smoothing, drift and retention against loops written from their definitions."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cellquant.errors import InputError
from cellquant.observables import observe
from cellquant.observables.smoothing import from_tracks, smooth, survey
from cellquant.observables.trajectories import Trajectories
from cellquant.tables import Tracks
from observables_examples import brownian, tracks_of, with_gaps


def naive_average(x: np.ndarray, half: int) -> np.ndarray:
    """Moving average of one run of consecutive frames, shrinking towards the ends."""
    out = np.empty_like(x)
    for i in range(x.size):
        h = min(half, i, x.size - 1 - i)
        out[i] = x[i - h : i + h + 1].mean()
    return out


def positions(paths: Trajectories) -> np.ndarray:
    """(M, 2) positions of the entries; NaN where there is none."""
    track = np.repeat(np.arange(paths.n_tracks), np.diff(paths.offsets))
    place = np.column_stack([paths.x, paths.y]) + paths.start[track]
    return np.where(paths.valid[:, None], place, np.nan)


def known(paths: Trajectories) -> np.ndarray:
    """The positions that there are, in the order of track and frame."""
    return positions(paths)[paths.valid]


@given(seed=st.integers(0, 10**6), points=st.sampled_from([1, 3, 5, 9]))
@settings(deadline=None, max_examples=25)
def test_smoothing_is_the_average_of_each_run(seed: int, points: int) -> None:
    rng = np.random.default_rng(seed)
    tracks = with_gaps(brownian(rng, 4, 30), rng, 0.15)
    found = known(smooth(from_tracks(tracks), points))[:, 0]
    for _, rows in tracks.table.groupby("track_id"):
        run = (rows["frame"].diff() != 1).cumsum()
        for _, part in rows.groupby(run):
            expected = naive_average(part["x"].to_numpy(), points // 2)
            np.testing.assert_allclose(found[part.index], expected, atol=1e-12)


def test_smoothing_leaves_the_ends_and_the_source_alone() -> None:
    tracks = brownian(np.random.default_rng(0), 3, 12)
    paths, before = from_tracks(tracks), from_tracks(tracks)
    found = smooth(paths)
    np.testing.assert_array_equal(paths.x, before.x)
    ends = [0, 11, 12, 23, 24, 35]
    np.testing.assert_array_equal(found.x[ends], before.x[ends])
    # In place of the source the numbers are the same.
    again = smooth(paths, overwrite=True)
    for name in ("x", "y", "centre"):
        assert getattr(again, name).tobytes() == getattr(found, name).tobytes()
    assert again.x is paths.x
    mean = [known(found)[k : k + 12].mean(axis=0) for k in (0, 12, 24)]
    np.testing.assert_allclose(found.centre, mean, atol=1e-12)


@pytest.mark.parametrize("points", [0, 2, -5])
def test_smoothing_refuses_even_widths(points: int) -> None:
    with pytest.raises(ValueError, match="odd"):
        smooth(from_tracks(brownian(np.random.default_rng(0), 2, 9)), points)


def test_tracks_that_came_smoothed_are_not_smoothed_again() -> None:
    tracks = replace(brownian(np.random.default_rng(0), 20, 30), smoothing=3)
    found = observe(tracks, only=["msd"])
    assert found.summary["processing"]["smoothing_points"] == 3
    plain = observe(replace(tracks, smoothing=1), only=["msd"], smoothing=1)
    pd.testing.assert_frame_equal(found.tables["msd"], plain.tables["msd"])


def test_a_position_that_is_not_a_number_ends_a_run() -> None:
    tracks = brownian(np.random.default_rng(1), 1, 11)
    tracks.table.loc[5, "x"] = np.nan
    found = positions(smooth(from_tracks(tracks)))[:, 0]
    x = tracks.table["x"].to_numpy()
    np.testing.assert_allclose(found[:5], naive_average(x[:5], 2))
    np.testing.assert_allclose(found[6:], naive_average(x[6:], 2))
    assert np.isnan(found[5])


def test_drift_of_a_rigid_translation_is_removed_exactly() -> None:
    rng = np.random.default_rng(2)
    still = rng.uniform(0, 9, (20, 1, 2))
    path = np.cumsum(rng.normal(0, 1, (1, 30, 2)), axis=1)
    path[:, 0] = 0
    tracks = tracks_of(still + path)
    moved = from_tracks(tracks, drift=True)
    assert max(np.abs(moved.x).max(), np.abs(moved.y).max()) < 1e-12
    assert survey(tracks, drift=True).drift == {"removed": True, "steps_kept": 0, "min_cells": 8}


def test_cells_that_enter_and_leave_fake_no_drift() -> None:
    # Cells stand still; those on the right appear late, those on the left leave early, so that
    # the mean position wanders by half the field.
    rng = np.random.default_rng(3)
    place = np.repeat(rng.uniform(0, 100, (60, 1, 2)), 40, axis=1)
    left = place[:, 0, 0] < 50
    place[left, 25:] = np.nan
    place[~left, :15] = np.nan
    found = known(from_tracks(tracks_of(place), drift=True))
    np.testing.assert_allclose(found, tracks_of(place).table[["x", "y"]])


def test_drift_uses_the_steps_of_common_cells() -> None:
    rng = np.random.default_rng(4)
    tracks = with_gaps(brownian(rng, 30, 20), rng, 0.3)
    found = known(from_tracks(tracks, drift=True))
    wide = tracks.table.pivot(index="frame", columns="track_id", values="x")
    drift = wide.diff().mean(axis=1).fillna(0).cumsum()
    expected = tracks.table["x"].to_numpy() - drift.loc[tracks.table["frame"]].to_numpy()
    np.testing.assert_allclose(found[:, 0], expected, atol=1e-12)


def test_few_cells_keep_their_motion() -> None:
    tracks = brownian(np.random.default_rng(5), 3, 10)
    found = known(from_tracks(tracks, drift=True))
    np.testing.assert_allclose(found, tracks.table[["x", "y"]], atol=1e-12)
    drift = survey(tracks, drift=True).drift
    assert drift == {"removed": False, "steps_kept": 9, "min_cells": 8}


def test_retention_counts_consecutive_points() -> None:
    place = np.zeros((3, 50, 2))
    place[1, 23] = np.nan  # runs of 23 and 26
    place[2, ::20] = np.nan  # runs of at most 19
    found = survey(tracks_of(place), min_points=24)
    assert found.kept.tolist() == [True, True, False]
    assert found.longest_run == 50
    kept = from_tracks(tracks_of(place), min_points=24)
    assert np.diff(kept.offsets).tolist() == [50, 50]
    assert kept.valid.sum() == 99
    assert from_tracks(tracks_of(place), min_points=51).n_tracks == 0
    with pytest.raises(ValueError, match="min_points"):
        survey(tracks_of(place), min_points=0)


def test_rows_in_any_order_give_the_same_tracks() -> None:
    rng = np.random.default_rng(6)
    tracks = with_gaps(brownian(rng, 12, 30), rng)
    shuffled = Tracks(
        tracks.table.sample(frac=1, random_state=1), tracks.units, 1.0, tracks.area, None
    )
    one, other = (from_tracks(t, drift=True, min_points=3) for t in (shuffled, tracks))
    for name in ("x", "y", "valid", "offsets", "first_frame", "centre"):
        assert getattr(one, name).tobytes() == getattr(other, name).tobytes()


def test_two_positions_in_one_frame_are_refused() -> None:
    tracks = brownian(np.random.default_rng(7), 2, 5)
    table = pd.concat([tracks.table, tracks.table.iloc[[7]]])
    twice = Tracks(table, tracks.units, 1.0, tracks.area, None)
    with pytest.raises(InputError, match="track 2 has 2 rows in frame 2"):
        from_tracks(twice)


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

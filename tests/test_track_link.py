"""Linking: closed forms, invariances, broken input."""

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.optimize import linear_sum_assignment

import cellquant as cq
from cellquant.errors import InputError
from cellquant.io import LabelStack, read_images, read_labels
from cellquant.segment import measure_cells
from cellquant.tables import PIXEL, TRACK_COLUMNS, Cells
from cellquant.track import track_cells
from cellquant.track.assign import match, match_with_divisions
from cellquant.track.belief import marginals, option_marginals
from cellquant.track.confidence import Choice, calibrated
from cellquant.track.divisions import _log_frequency, broken_masks, weigh
from cellquant.track.evaluate import evaluate
from cellquant.track.flow import pair_flow
from cellquant.track.motion_kernels import add_weighted, decay, squared_residuals
from cellquant.track.movie import Links, flatten
from cellquant.track.near import nearest_cells
from cellquant.track.solve import Options, solve


def discs(paths: np.ndarray, *, size: int = 120, radius: float = 3.2) -> np.ndarray:
    """Label masks of discs that follow paths (T, n, 2) as x, y; NaN where absent."""
    y, x = np.mgrid[:size, :size]
    stack = np.zeros((len(paths), size, size), dtype=np.int32)
    for frame, points in enumerate(paths):
        for label, (px, py) in enumerate(points, start=1):
            if np.isfinite(px):
                stack[frame][(x - px) ** 2 + (y - py) ** 2 <= radius**2] = label
    return stack


def stack_of(array: np.ndarray) -> LabelStack:
    return LabelStack.from_array(array, units="pixel")


def lattice(n: int = 5, spacing: float = 14.0, corner: float = 20.0) -> np.ndarray:
    grid = corner + spacing * np.arange(n)
    return np.array([(x, y) for y in grid for x in grid])


def test_uniform_drift_gives_one_track_per_cell() -> None:
    start = lattice()
    paths = start[None] + np.arange(8)[:, None, None] * np.array([3.0, -1.0])
    tracks = cq.track(stack_of(discs(paths)))
    table = tracks.table
    assert list(table.columns[: len(TRACK_COLUMNS)]) == list(TRACK_COLUMNS)
    assert tracks.n_tracks == len(start)
    assert (table.groupby("track_id")["label"].nunique() == 1).all()
    assert (table["parent_track_id"] == 0).all()


def test_single_frame_is_refused() -> None:
    with pytest.raises(InputError, match="at least two frames"):
        cq.track(stack_of(discs(lattice()[None])))


def test_background_movie_is_refused() -> None:
    with pytest.raises(InputError, match="holds a cell"):
        cq.track(stack_of(np.zeros((4, 20, 20), dtype=np.int32)))


def test_linear_crossing_keeps_identity_by_history() -> None:
    """Two rows of cells pass through each other: only the path tells who is who."""
    y = np.arange(20.0, 110.0, 22.0)
    right = np.column_stack((np.full(len(y), 15.0), y))
    left = np.column_stack((np.full(len(y), 105.0), y + 11.0))
    times = np.arange(16)[:, None, None]
    paths = np.concatenate(
        (right[None] + times * [5.0, 0.0], left[None] - times * [5.0, 0.0]), axis=1
    )
    tracks = cq.track(stack_of(discs(paths, size=125)), divisions=False)
    lengths = tracks.table.groupby("track_id").size()
    assert len(lengths) == 2 * len(y)
    assert (tracks.table.groupby("track_id")["label"].nunique() == 1).all()


def test_single_cell_is_followed() -> None:
    paths = np.array([[[20.0 + 2 * t, 30.0]] for t in range(6)])
    tracks = cq.track(stack_of(discs(paths)))
    assert tracks.n_tracks == 1
    assert np.isnan(tracks.table["link_confidence"].iloc[0])
    assert (tracks.table["link_confidence"].iloc[1:] > 0.5).all()


def test_missing_cell_is_bridged_within_max_gap() -> None:
    paths = np.repeat(lattice()[None], 12, axis=0) + 0.5 * np.arange(12)[:, None, None]
    paths[5, 7] = paths[5:7, 12] = np.nan
    array = discs(paths)
    bridged = cq.track(stack_of(array))
    assert bridged.provenance["gaps_closed"] == 2
    assert bridged.n_tracks == 25
    cut = cq.track(stack_of(array), max_gap=0)
    assert cut.provenance["gaps_closed"] == 0
    assert cut.n_tracks == 27


def test_empty_frame_within_a_movie() -> None:
    paths = np.repeat(lattice()[None], 9, axis=0) + np.arange(9)[:, None, None]
    array = discs(paths)
    array[4] = 0
    tracks = cq.track(stack_of(array))
    assert tracks.n_tracks == 25
    assert set(tracks.table["frame"]) == {0, 1, 2, 3, 5, 6, 7, 8}
    assert any("frames without cells" in text for text in tracks.provenance["warnings"])


def test_divisions_are_found_and_can_be_switched_off() -> None:
    rng = np.random.default_rng(2)
    start = lattice(7, 26.0, 22.0)
    n = len(start)
    paths = np.full((10, n + 8, 2), np.nan)
    mothers = rng.permutation(n)[:8]
    for t in range(10):
        paths[t, :n] = start + 0.3 * t
        for k, mother in enumerate(mothers):
            if t > k:
                paths[t, mother] = start[mother] + [-5.0, 0.3 * t]
                paths[t, n + k] = start[mother] + [5.0, 0.3 * t]
    array = discs(paths, size=205, radius=4.6)
    tracks = cq.track(stack_of(array))
    assert tracks.provenance["divisions"] == 8
    families = tracks.table[tracks.table["parent_track_id"] > 0].groupby("parent_track_id")
    assert (families["track_id"].nunique() == 2).all()
    # One daughter of some is cut by the edge of the view.
    some = np.sum(start[mothers, 0] == start[:, 0].min())
    cropped = array[:, :, 16:]
    assert some > 0
    assert len(np.unique(cropped[-1, :, 0])) > some
    assert cq.track(stack_of(cropped)).provenance["divisions"] == 8
    without = cq.track(stack_of(array), divisions=False)
    assert (without.table["parent_track_id"] == 0).all()


def wandering(seed: int = 0, frames: int = 8) -> np.ndarray:
    rng = np.random.default_rng(seed)
    steps = rng.normal(scale=1.2, size=(frames, 25, 2)) + np.array([1.0, 0.5])
    return lattice()[None] + np.cumsum(steps, axis=0)


def test_labels_carry_no_information() -> None:
    array = discs(wandering())
    rng = np.random.default_rng(1)
    shuffled = np.zeros_like(array)
    names = []
    for frame, image in enumerate(array):
        new = np.append(0, rng.permutation(int(image.max())) + 1)
        shuffled[frame] = new[image]
        names.append(np.argsort(new))
    one = cq.track(stack_of(array)).table
    other = cq.track(stack_of(shuffled)).table
    other["label"] = [names[f][n] for f, n in zip(other["frame"], other["label"], strict=True)]
    pd.testing.assert_frame_equal(other, one, check_exact=True)


def test_same_input_gives_equal_tables() -> None:
    stack = stack_of(discs(wandering(3)))
    pd.testing.assert_frame_equal(cq.track(stack).table, cq.track(stack).table, check_exact=True)


def test_shuffled_time_is_noticed() -> None:
    rng = np.random.default_rng(5)
    paths = np.array([rng.random((25, 2)) * 100 + 10 for _ in range(6)])
    tracks = cq.track(stack_of(discs(paths)))
    assert tracks.provenance["warnings"]


def test_raw_movie_takes_part(tmp_path: Path) -> None:
    array = discs(wandering(4))
    rng = np.random.default_rng(0)
    raw = (array > 0) * 100 + rng.integers(0, 20, array.shape)
    tifffile.imwrite(tmp_path / "raw.tif", raw.astype(np.uint16), metadata={"axes": "TYX"})
    images = read_images(tmp_path / "raw.tif")
    assert cq.track(stack_of(array), raw=images).n_tracks >= 25


def test_wrong_options_are_refused() -> None:
    stack = stack_of(discs(wandering()))
    with pytest.raises(InputError, match="max_distance"):
        cq.track(stack, max_distance=-1.0)
    with pytest.raises(InputError, match="linker"):
        cq.track(stack, linker="magic")
    with pytest.raises(InputError, match="max_gap"):
        cq.track(stack, max_gap=-1)


def test_max_distance_forbids_longer_steps() -> None:
    paths = lattice()[None] + np.arange(5)[:, None, None] * np.array([6.0, 0.0])
    tracks = cq.track(stack_of(discs(paths)), max_distance=4.0)
    assert tracks.provenance["links"] == 0
    assert (tracks.table["parent_track_id"] == 0).all()


def test_trackpy_baseline_follows_slow_cells() -> None:
    tracks = cq.track(stack_of(discs(wandering(6))), linker="trackpy")
    assert tracks.provenance["settings"]["linker"] == "trackpy"
    assert tracks.n_tracks >= 25


def cells_at(points: list[np.ndarray]) -> Cells:
    """Cells at given points, all round and equal, without masks."""
    parts = [
        pd.DataFrame(
            {"frame": frame, "label": np.arange(1, len(p) + 1), "x": p[:, 0], "y": p[:, 1]}
        )
        for frame, p in enumerate(points)
    ]
    table = pd.concat(parts, ignore_index=True).assign(
        area=30.0,
        perimeter=20.0,
        shape_index=3.65,
        aspect_ratio=1.0,
        orientation=0.0,
        touches_border=False,
        n_neighbours=0,
    )
    return Cells(
        table.astype({"frame": "int64", "label": "int64"}),
        PIXEL,
        1.0,
        1.0,
        (100.0, 100.0),
        len(points),
        np.full(len(points), 1e4),
    )


point_sets = st.lists(
    st.integers(0, 12).flatmap(
        lambda n: arrays(np.float64, (n, 2), elements=st.floats(0.0, 100.0, width=16))
    ),
    min_size=2,
    max_size=5,
)


@settings(max_examples=40, deadline=None)
@given(point_sets)
def test_any_points_give_every_cell_one_track(points: list[np.ndarray]) -> None:
    cells = cells_at(points)
    if cells.table.empty:
        with pytest.raises(InputError):
            track_cells(cells)
        return
    table = track_cells(cells).table
    assert len(table) == len(cells.table)
    assert not table.duplicated(["frame", "label"]).any()
    assert not table.duplicated(["track_id", "frame"]).any()
    assert sorted(table["track_id"].unique()) == list(range(1, table["track_id"].nunique() + 1))
    born = table.groupby("track_id")["parent_track_id"].first()
    assert born[born > 0].value_counts().isin([2]).all()


@settings(max_examples=60, deadline=None)
@given(arrays(np.float64, (4, 5), elements=st.floats(-3.0, 5.0, width=16)))
def test_match_is_optimal(gains: np.ndarray) -> None:
    row, column = np.indices(gains.shape).reshape(2, -1)
    chosen = match(row, column, gains.reshape(-1))
    assert len(set(row[chosen])) == len(set(column[chosen])) == len(chosen)
    clipped = np.maximum(gains, 0.0)
    oracle = clipped[linear_sum_assignment(-clipped)].sum()
    assert gains.reshape(-1)[chosen].sum() == pytest.approx(oracle)


def test_match_with_divisions_prefers_the_better_explanation() -> None:
    rows, columns = np.array([0, 1]), np.array([10, 11])
    family = np.array([[0, 10, 11]])
    links, split = match_with_divisions(
        rows, columns, np.array([2.0, 1.0]), family, np.array([5.0])
    )
    assert len(links) == 0
    assert split.tolist() == [0]
    links, split = match_with_divisions(
        rows, columns, np.array([3.0, 3.0]), family, np.array([5.0])
    )
    assert links.tolist() == [0, 1]
    assert len(split) == 0


def test_rare_sizes_are_as_rare_as_they_occur() -> None:
    """A handful of merged cells must not look impossible, or anything would explain them better."""
    sizes = np.random.default_rng(0).normal(scale=0.1, size=2000)
    sizes[:20] += np.log(2.0)
    log_density = _log_frequency(sizes)
    normal = -0.5 * (sizes / 0.1) ** 2 - np.log(0.1 * np.sqrt(2 * np.pi))
    assert np.median(normal[:20]) < -15.0
    assert (log_density[:20] > -7.0).all()
    assert np.median(np.abs(log_density[20:] - normal[20:])) < 0.5


def test_a_mask_that_falls_apart_is_no_division() -> None:
    masks = np.zeros((3, 20, 40), dtype=np.int32)
    masks[:, 5:15, 5:15] = 1
    masks[1:, 5:15, 10:15] = 2
    masks[2, 5:15, 5:15] = 1
    masks[:, 5:15, 25:35] = 3
    masks[1:, 5:15, 30:35] = 4
    movie = flatten(measure_cells(stack_of(masks)))
    order = np.lexsort((movie.label, movie.frame))
    whole, other, half, rest, part, twin, again, stays, goes = order.tolist()
    after = np.full(9, -1)
    after[[whole, other, half, part, twin]] = half, part, again, stays, goes
    links = Links(after, np.full(9, -1), np.full(9, -1), np.ones(9))
    families = np.array([[whole, half, rest], [whole, rest, half], [other, part, twin]])
    assert broken_masks(movie, links, families).tolist() == [half, half, -1]


def test_a_family_is_weighed_against_the_links_it_would_break() -> None:
    candidates = np.array([[2, 3], [3, 4], [-1, -1], [-1, -1], [-1, -1]])
    gain = np.array([[5.0, 1.0], [4.0, 3.0]] + [[-np.inf, -np.inf]] * 3)
    cells = np.array([[0, 2, 4], [1, 3, 4]])
    odds = np.array([5.5, 2.0])
    nobody = np.empty(0, dtype=np.int64)
    source, target, held = np.array([0, 1]), np.array([2, 3]), np.array([5.0, 4.0])
    found = weigh(cells, odds, nobody, source, target, held, candidates, gain)
    better = np.exp(odds - np.array([5.0, 4.0]))
    np.testing.assert_allclose(found.weight, better / (1.0 + better.sum()))
    source, target, held = np.array([1]), np.array([3]), np.array([4.0])
    taken = weigh(cells, odds, np.array([0]), source, target, held, candidates, gain)
    assert taken.chosen.tolist()[0]
    assert taken.weight[0] == 1.0


def test_flow_is_followed_where_it_shows_and_small_where_nothing_can_be_told() -> None:
    rng = np.random.default_rng(5)
    grid = 10.0 * np.stack(np.meshgrid(range(20), range(20)), axis=-1).reshape(-1, 2)
    here = grid + rng.normal(0, 1.5, grid.shape)
    shift = np.array([7.0, 3.0])
    strangers = rng.random(here.shape) * 200.0
    for there, expected, error in ((here + shift, shift, 0.5), (strangers, 0.0 * shift, 2.0)):
        movie = flatten(replace(cells_at([here, there]), field_of_view=(200.0, 200.0)))
        flow = pair_flow(movie, 0, np.zeros_like(here))
        inside = movie.margin[movie.cells_of(0)] > 30.0
        assert np.abs(flow[inside] - expected).max() < error


def test_steps_scatter_more_in_a_frame_with_a_jolt() -> None:
    rng = np.random.default_rng(0)
    start = np.array([(x, y) for y in range(10, 250, 12) for x in range(10, 250, 12)], dtype=float)
    scale = np.array([0.3, 0.3, 1.5, 0.3, 0.3])
    steps = rng.normal(size=(5, len(start), 2)) * scale[:, None, None]
    paths = np.concatenate((start[None], start + np.cumsum(steps, axis=0)))
    cells = replace(cells_at(list(paths)), field_of_view=(260.0, 260.0))
    solution = solve(flatten(cells), Options())
    spread = [float(np.median(solution.motion.spread[i * 400 : (i + 1) * 400])) for i in range(5)]
    assert spread[2] > 2.0 * max(spread[i] for i in (0, 1, 3, 4))


def test_a_wide_start_does_not_trust_the_shortest_links() -> None:
    """Where steps are as long as cells are apart, a narrow start finds its own links short.

    A start at a seventh of the spacing gets 41 % of these links right, a wide one 51 %.
    """
    rng = np.random.default_rng(1)
    start = np.array([(x, y) for y in range(0, 300, 10) for x in range(0, 300, 10)], dtype=float)
    start += rng.normal(scale=1.5, size=start.shape)
    steps = rng.normal(scale=5.0, size=(4, *start.shape))
    paths = np.concatenate((start[None], start + np.cumsum(steps, axis=0)))
    cells = replace(cells_at(list(paths)), field_of_view=(300.0, 300.0))
    movie = flatten(cells)
    solution = solve(movie, Options(divisions=False))
    assert solution.links is not None
    after, n = solution.links.after, len(start)
    right = after[: 4 * n] == np.arange(4 * n) + n
    assert right.mean() > 0.46


def test_cells_at_the_rim_of_a_layer_are_known() -> None:
    points = np.array([(x, y) for y in range(40, 70, 5) for x in range(40, 70, 5)], dtype=float)
    rim = flatten(cells_at([points, points])).rim[: len(points)]
    inside = ((points > 40.0) & (points < 65.0)).all(axis=1)
    assert not rim[inside].any()
    assert rim[~inside].all()


def test_marginals_are_those_of_all_matchings() -> None:
    """Exact on a chain of candidates, by counting every way to link its cells."""
    nothing = -np.inf
    gain = np.array([[1.5, -0.5], [2.0, nothing], [0.3, 1.0]] + [[nothing, nothing]] * 3)
    candidates = np.array([[3, 4], [4, -1], [5, 4]] + [[-1, -1]] * 3)
    out = np.empty(gain.shape)
    marginals(gain, candidates, np.array([0, 3, 6]), 8, -15.0, 9.0, out)
    weight, total = np.zeros((3, 2)), 0.0
    for slots in product((0, 1, -1), repeat=3):
        chosen = [(row, slot) for row, slot in enumerate(slots) if slot >= 0]
        targets = [candidates[key] for key in chosen]
        if -1 in targets or len(set(targets)) < len(targets):
            continue
        worth = np.exp(sum(gain[key] for key in chosen))
        total += worth
        for key in chosen:
            weight[key] += worth
    assert out[:3] == pytest.approx(weight / total, abs=1e-6)
    assert (out[3:] == 0.0).all()


def test_links_and_divisions_are_judged_together() -> None:
    """Exact where options and cells form a tree, by counting every way to choose."""
    # Sources 0 and 1, targets 2 to 5.
    cells = np.array([[0, 2, -1], [0, 3, 4], [1, 3, -1], [1, 5, -1]])
    gain = np.array([1.0, 2.5, 1.5, -0.5])
    out = np.empty(4)
    option_marginals(cells, gain, 8, out)
    weight, total = np.zeros(4), 0.0
    for taken in product((False, True), repeat=4):
        used = cells[list(taken)]
        used = used[used >= 0]
        if len(set(used.tolist())) == len(used):
            worth = np.exp(gain[list(taken)].sum())
            total += worth
            weight[list(taken)] += worth
    assert out == pytest.approx(weight / total, abs=1e-6)


def test_confidence_is_cooler_where_links_are_in_doubt() -> None:
    nobody = np.full(8, -1)
    # Two links and a division, each with one rival; cells 0 to 2 are followed by 3 to 7.
    cells = np.array([[0, 3, -1], [0, 4, -1], [1, 4, -1], [2, 7, -1], [2, 5, 6]])
    gain = np.array([7.0, 1.0, 7.0, 2.0, 10.0])
    choice = Choice(cells, gain, np.array([0, 2]), np.array([4]))
    stated = {}
    for doubt in (0.001, 0.02):
        before = np.zeros(8)
        before[[3, 4]] = 1.0 - doubt
        links = calibrated(Links(nobody, nobody, nobody, before), choice)
        stated[doubt] = links.confidence
        # The division against nothing and against another link of its mother, at a quarter.
        division, rival = np.exp(10.0 / 4.0), np.exp(2.0 / 4.0)
        assert links.confidence[5] == links.confidence[6]
        assert links.confidence[5] == pytest.approx(division / (1.0 + rival + division))
        assert links.confidence[7] == 0.0
    assert stated[0.001][3] == pytest.approx(1.0 / (1.0 + np.exp(-7.0)), abs=1e-5)
    assert stated[0.02][3] < 0.95


def test_a_sure_link_is_not_propagated_and_keeps_its_odds() -> None:
    """The short cut for links beyond doubt agrees with propagation, and drops their rivals."""
    gain = np.array([[14.0, -1.0], [-2.0, 3.0]] + [[-np.inf] * 2] * 2)
    candidates = np.array([[2, 3], [2, 3], [-1, -1], [-1, -1]])
    short, full = np.empty(gain.shape), np.empty(gain.shape)
    marginals(gain, candidates, np.array([0, 2, 4]), 8, -15.0, 9.0, short)
    marginals(gain, candidates, np.array([0, 2, 4]), 8, -15.0, np.inf, full)
    assert short[0, 1] == short[1, 0] == 0.0
    assert short == pytest.approx(full, abs=1e-4)


@settings(max_examples=40, deadline=None)
@given(
    arrays(
        np.float64, st.tuples(st.integers(0, 40), st.just(2)), elements=st.floats(0, 9, width=16)
    ),
    arrays(np.float64, (7, 2), elements=st.floats(-20, 30, width=16)),
    st.integers(1, 12),
)
def test_nearest_cells_are_the_nearest(there: np.ndarray, points: np.ndarray, k: int) -> None:
    found, square = nearest_cells(points, there, k)
    distance = ((points[:, None] - there[None]) ** 2).sum(axis=2)
    order = np.argsort(distance, axis=1, kind="stable")[:, :k]
    assert np.array_equal(found[:, : order.shape[1]], order)
    assert np.array_equal(square[:, : order.shape[1]], np.take_along_axis(distance, order, axis=1))
    assert (found[:, order.shape[1] :] == -1).all()


@pytest.mark.slow
def test_twenty_thousand_cells_per_frame_stay_bounded() -> None:
    rng = np.random.default_rng(0)
    side = np.sqrt(20_000.0) * 10
    start = rng.random((20_000, 2)) * side
    points = [
        start,
        start + rng.normal(scale=2.0, size=start.shape),
        rng.random((20_000, 2)) * side,
    ]
    cells = cells_at(points)
    cells = replace(cells, field_of_view=(side, side))
    assert track_cells(cells).provenance["links"] > 18_000


@pytest.mark.parametrize(
    ("name", "edge", "division", "idf1"),
    [("epidermis_area1", 0.965, 0.75, 0.86), ("cell_migration", 0.9997, 0.93, 0.994)],
)
def test_real_recordings_with_shuffled_labels(
    recordings: Path, name: str, edge: float, division: float, idf1: float
) -> None:
    stack = read_labels(recordings / name / "TRA", units="pixel")
    rng = np.random.default_rng(11)
    shuffled = []
    for image in stack:
        labels = np.unique(image)
        new = np.zeros(int(image.max()) + 1, dtype=np.int32)
        new[labels[labels > 0]] = rng.permutation(int((labels > 0).sum())) + 1
        shuffled.append(new[image])
    tracks = cq.track(LabelStack.from_array(np.stack(shuffled), units="pixel"))
    scores = evaluate(tracks, recordings / name)
    assert scores.edge_f1 >= edge
    assert scores.division_f1 >= division
    assert scores.idf1 >= idf1


def test_large_tangles_are_solved_by_exchange(monkeypatch: pytest.MonkeyPatch) -> None:
    """The bounded way uses no cell twice and comes close to the integer program."""
    rng = np.random.default_rng(4)
    rows, columns = np.indices((30, 40)).reshape(2, -1)
    gains = rng.normal(size=rows.size)
    families = np.column_stack(
        (rng.integers(0, 30, 60), [rng.choice(40, 2, replace=False) for _ in range(60)])
    )
    odds = rng.normal(2.0, 2.0, 60)
    worth = []
    for limit in (4000, 10):
        monkeypatch.setattr("cellquant.track.assign.PROGRAM_LIMIT", limit)
        links, split = match_with_divisions(rows, columns, gains, families, odds)
        mothers = np.concatenate((rows[links], families[split, 0]))
        daughters = np.concatenate((columns[links], families[split, 1:].reshape(-1)))
        assert len(set(mothers)) == len(mothers)
        assert len(set(daughters)) == len(daughters)
        worth.append(gains[links].sum() + odds[split].sum())
    assert 0.9 * worth[0] <= worth[1] <= worth[0] + 1e-9


def test_compiled_sums_of_the_fit_equal_the_matrices() -> None:
    rng = np.random.default_rng(5)
    x, y, weight = rng.normal(size=(80, 6)), rng.normal(size=80), rng.random(40)
    coefficient, square = rng.normal(size=6), np.empty(40)
    squared_residuals(x, y, coefficient, square)
    rest = (y - x @ coefficient).reshape(-1, 2)
    assert square == pytest.approx((rest**2).sum(axis=1), rel=1e-13)
    normal, right = np.eye(6), np.ones(6)
    add_weighted(x, y, weight, normal, right)
    both = np.repeat(weight, 2)
    assert normal == pytest.approx(np.eye(6) + x.T @ (both[:, None] * x), rel=1e-12, abs=1e-12)
    assert right == pytest.approx(1.0 + x.T @ (both * y), rel=1e-12, abs=1e-12)


def test_decay_is_the_exponential() -> None:
    x = np.concatenate((-np.geomspace(1e-12, 11.999, 4001), [0.0]))
    found = x.copy()
    decay(found)
    np.testing.assert_allclose(found, np.exp(x), rtol=1e-8)
    far = np.array([-12.0, -700.0, -1e300])
    decay(far)
    assert far.tolist() == [0.0, 0.0, 0.0]

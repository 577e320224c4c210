"""Static structure: ideal gas, lattice, naive sums and freud."""

import numpy as np
import pytest

from cellquant.observables import observe
from cellquant.observables.bonds import bond_order, neighbour_pairs
from cellquant.observables.pairs import pair_correlation
from cellquant.observables.region import Region
from cellquant.observables.structure import structure_factor
from cellquant.tables import PHYSICAL, Cells
from observables_examples import brownian, movie, tracks_of

BOX = (10.0, 8.0)


def gas(rng: np.random.Generator, n: int = 60, frames: int = 1, box=BOX):
    return tracks_of(rng.uniform(0, 1, (n, frames, 2)) * box, box=box)


def triangular(n: int = 12) -> tuple[np.ndarray, tuple[float, float]]:
    """n x n triangular lattice of unit spacing (n even) and its periodic box."""
    i, j = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    place = np.column_stack([(i + 0.5 * (j % 2)).ravel(), (j * np.sqrt(3) / 2).ravel()])
    return place, (float(n), n * np.sqrt(3) / 2)


def test_structure_factor_agrees_with_a_naive_sum() -> None:
    tracks = gas(np.random.default_rng(0), frames=3)
    found = structure_factor(tracks, max_wave_number=5.0).table
    step = 2 * np.pi / np.array(BOX)
    values: dict[int, list[float]] = {}
    for a in range(20):
        for b in range(-20, 20):
            q = step * (a, b)
            if not 0 < np.hypot(*q) <= 5.0 or (a == 0 and b < 0):
                continue
            shell = max(int(np.floor(np.hypot(*q) / step.max() - 0.5)), 0)
            power = [
                abs(np.exp(-1j * (rows[["x", "y"]].to_numpy() @ q)).sum()) ** 2 / 60
                for _, rows in tracks.table.groupby("frame")
            ]
            values.setdefault(shell, []).append(np.mean(power))
    expected = [np.mean(values[k]) for k in sorted(values)]
    np.testing.assert_allclose(found["value"], expected, rtol=1e-11)
    assert found["n_vectors"].tolist() == [len(values[k]) for k in sorted(values)]


def test_ideal_gas_has_no_structure() -> None:
    rng = np.random.default_rng(1)
    tracks = gas(rng, n=200, frames=20, box=(14.0, 14.0))
    found = structure_factor(tracks, diameter=1.0)
    pull = (found.table["value"] - 1) / found.table["std_error"]
    assert pull.std() == pytest.approx(1, abs=0.3)
    assert found.peak["q_peak"] is None
    assert "scatter of independent" in found.peak["reason"]
    g = pair_correlation(tracks, diameter=1.0).table
    assert ((g["value"] - 1) / g["std_error"]).std() == pytest.approx(1, abs=0.4)


def test_ideal_gas_in_an_open_field_has_no_structure() -> None:
    rng = np.random.default_rng(2)
    tracks = tracks_of(rng.uniform(0, 14, (400, 15, 2)))
    table = structure_factor(tracks, diameter=1.0).table
    far = table[table["wave_number"] > 2]
    assert far["value"].mean() == pytest.approx(1, abs=0.02)
    g = pair_correlation(tracks, diameter=1.0, max_distance=6.0).table
    # The exact cover of the rectangle keeps g = 1 out to nearly half the edge.
    assert g["value"].iloc[-20:].mean() == pytest.approx(1, abs=0.02)


def test_triangular_lattice() -> None:
    place, box = triangular()
    rng = np.random.default_rng(3)
    frames = place[:, None] + rng.normal(0, 0.02, (len(place), 6, 2))
    tracks = tracks_of(frames, box=box)
    found = structure_factor(tracks, diameter=1.0)
    assert found.table["value"].max() > 15
    # 4 pi/sqrt(3), to the width of a shell.
    assert found.peak["q_peak"] == pytest.approx(4 * np.pi / np.sqrt(3), abs=0.3)
    order = bond_order(tracks)
    assert order.summary["mean"] > 0.95
    assert order.summary["global"] > 0.95
    assert order.neighbour_summary["mean"] == pytest.approx(6)
    assert order.neighbours["n_neighbours"].tolist() == [6]
    g = pair_correlation(tracks, diameter=1.0)
    assert g.table["distance"][g.table["value"].idxmax()] == pytest.approx(1, abs=0.05)


def test_global_order_of_random_points_is_small() -> None:
    order = bond_order(gas(np.random.default_rng(4), n=400, frames=8))
    assert order.summary["global"] < 0.1
    assert order.neighbour_summary["mean"] == pytest.approx(6, abs=1e-9)  # Euler, on a torus


def test_periodic_neighbours_are_symmetric() -> None:
    rng = np.random.default_rng(5)
    for n in (5, 12, 80):
        place = rng.uniform(0, 1, (n, 2)) * BOX
        pairs, bonds, inside = neighbour_pairs(place, np.array(BOX))
        assert inside.all()
        forward = sorted(
            (a, b, round(x, 9), round(y, 9)) for (a, b), (x, y) in zip(pairs, bonds, strict=True)
        )
        backward = sorted(
            (b, a, round(-x, 9), round(-y, 9)) for (a, b), (x, y) in zip(pairs, bonds, strict=True)
        )
        np.testing.assert_allclose(forward, backward, atol=1e-8)


def test_hexatic_order_and_distances_agree_with_freud() -> None:
    freud = pytest.importorskip("freud", reason="pip install freud-analysis")
    rng = np.random.default_rng(6)
    place = rng.uniform(0, 12, (300, 2))
    tracks = tracks_of(place[:, None], box=(12.0, 12.0))
    box = freud.box.Box.square(12.0)
    points = np.column_stack([place - 6, np.zeros(300)]).astype(np.float32)
    cells = freud.locality.Voronoi().compute((box, points))
    peer = freud.order.Hexatic(k=6, weighted=False)
    peer.compute((box, points), neighbors=cells.nlist)
    found = bond_order(tracks)
    assert found.summary["mean"] == pytest.approx(np.abs(peer.particle_order).mean(), rel=2e-5)
    rdf = freud.density.RDF(bins=40, r_max=4.0, normalization_mode="finite_size")
    rdf.compute((box, points), reset=True)
    g = pair_correlation(tracks, max_distance=4.0, bin_width=0.1).table
    np.testing.assert_allclose(g["value"], rdf.rdf, atol=0.02)


def test_the_peak_is_that_of_the_spacing_also_where_nuclei_alone_are_seen() -> None:
    rng = np.random.default_rng(11)
    place, box = triangular(14)
    moved = place[:, None] + rng.normal(0, 0.06, (196, 12, 2))
    for diameter in (1.05, 0.4):
        peak = structure_factor(tracks_of(moved, box=box), diameter=diameter).peak
        assert peak["q_peak"] == pytest.approx(4 * np.pi / np.sqrt(3), rel=0.01)


def test_open_field_leaves_out_the_hull_and_the_border() -> None:
    rng = np.random.default_rng(7)
    place = rng.uniform(0, 10, (200, 1, 2))
    near_edge = ((place < 0.7) | (place > 9.3)).any(axis=2)
    found = bond_order(tracks_of(place, touches_border=near_edge))
    assert found.summary["n"] <= (~near_edge).sum()
    assert found.neighbour_summary["mean"] == pytest.approx(6, abs=0.15)


def test_a_field_that_cells_fill_in_part_is_said() -> None:
    rng = np.random.default_rng(12)
    place = rng.uniform(0, 20, (400, 1, 2)) + np.zeros((400, 3, 2))
    tracks = tracks_of(place[~((place > 8).all(axis=(1, 2)))])  # an empty corner
    for name in ("pair_correlation", "structure_factor"):
        found = observe(tracks, only=[name]).summary[name]
        assert found["filled"] == pytest.approx(0.64, abs=0.04)
        assert "of the rectangle" in found["note"]
    whole = tracks_of(rng.uniform(0, 20, (400, 3, 2)))
    assert "note" not in observe(whole, only=["pair_correlation"]).summary["pair_correlation"]


def test_the_overlap_of_a_region_with_itself_is_that_of_geometry() -> None:
    r = np.array([0.0, 0.3, 1.0, 4.0, 9.0, 30.0])
    side = np.arange(200) * 0.1 + 0.05
    disc = np.hypot(side[:, None] - 10, side[None] - 10) < 10
    inside = np.minimum(r, 20)
    exact = 200 * np.arccos(inside / 20) - 0.5 * inside * np.sqrt(400 - inside**2)
    found = Region(disc, np.array([0.1, 0.1])).overlap(r)
    np.testing.assert_allclose(found, exact, atol=0.002 * exact[0])
    oblong = Region(np.ones((200, 120), bool), np.array([0.1, 0.15]))  # 20 x 18
    exact = 360 - 2 * r[:5] * 38 / np.pi + r[:5] ** 2 / np.pi
    np.testing.assert_allclose(oblong.overlap(r)[:5], exact, rtol=2e-4)


@pytest.mark.parametrize("shape", ["disc", "wound", "corner"])
def test_g_of_a_partly_filled_field_is_that_of_a_full_one(shape: str) -> None:
    def inside(p: np.ndarray) -> np.ndarray:
        if shape == "disc":
            return np.hypot(*(p - 15).T) < 15
        if shape == "wound":
            return np.abs(p[:, 0] - 15) > 5
        return ~(p > 12).all(axis=1)

    rng = np.random.default_rng(13)
    frames = [p[inside(p)][:500] for p in rng.uniform(0, 30, (8, 2000, 2))]
    found = pair_correlation(tracks_of(np.stack(frames, axis=1)), diameter=1.3).table
    far = found["distance"] > 1.3
    # Normalised by the rectangle it would be 1.3 to 1.5.
    assert found["value"][far].mean() == pytest.approx(1, abs=0.03)
    # A layer with structure: cut out of a periodic crystal, turned, it has the g(r) of the whole.
    place, box = triangular(44)
    place = place + rng.normal(0, 0.18, place.shape)
    cut = place[inside(place - 5) & (place - 5 < 30).all(axis=1) & (place - 5 > 0).all(axis=1)]
    part, whole = (
        pair_correlation(tracks_of(p[:, None], box=b), diameter=1.0, max_distance=5.0).table
        for p, b in ((cut, None), (place, box))
    )
    near, far = part["distance"] < 1.8, part["distance"] > 1.8
    for used in (near, far):
        ratio = part["value"][used].sum() / whole["value"][used].sum()
        assert ratio == pytest.approx(1, abs=0.03)


def test_cells_and_tracks_of_one_movie_have_the_same_structure() -> None:
    tracks = movie(np.random.default_rng(13))
    columns = [name for name in tracks.table if name not in ("track_id", "parent_track_id", "time")]
    area = np.full(60, tracks.area)
    cells = Cells(tracks.table[columns], PHYSICAL, 1.0, 10.0, (500.0, 500.0), 60, area)
    for name in ("structure_factor", "pair_correlation", "neighbours"):
        one, other = (observe(source, only=[name]).tables[name] for source in (cells, tracks))
        np.testing.assert_allclose(one["value"], other["value"], rtol=1e-12)


@pytest.mark.parametrize("n", [0, 1, 2, 3])
def test_too_few_cells_give_reasons(n: int) -> None:
    tracks = tracks_of(np.random.default_rng(8).uniform(0, 1, (n, 2, 2)), area=1.0)
    assert structure_factor(tracks).peak["q_peak"] is None
    assert structure_factor(tracks).peak["reason"]
    order = bond_order(tracks)
    assert order.summary["mean"] is None
    assert order.summary["reason"]
    assert len(pair_correlation(tracks).table) == 0 or n >= 2


def test_cells_on_a_line_and_cells_on_one_spot() -> None:
    line = np.column_stack([np.arange(8.0), np.zeros(8)])[:, None]
    for place in (line, np.zeros((8, 1, 2))):
        tracks = tracks_of(place)
        assert structure_factor(tracks).peak["q_peak"] is None
        assert bond_order(tracks).summary["mean"] is None
        assert len(pair_correlation(tracks).table) == 0


def test_frames_are_spread_evenly() -> None:
    tracks = brownian(np.random.default_rng(9), 30, 100, box=(5.5, 5.5))
    assert bond_order(tracks, max_frames=5).hexatic["frame"].tolist() == [0, 25, 50, 74, 99]


def test_the_first_peak_of_pairs_within_its_error() -> None:
    # A lattice of spacing 1 that trembles: the peak of g(r) lies at 1, its error is small.
    rng = np.random.default_rng(10)
    place, box = triangular(14)
    moved = place[:, None] + rng.normal(0, 0.06, (196, 12, 2))
    found = pair_correlation(tracks_of(moved, box=box), diameter=1.0).peak
    # The factor 1/r of g(r) draws it in by the squared width of the distances, 0.0036 here.
    assert abs(found["peak_distance"] - 0.9964) < 4 * found["peak_distance_std_error"]
    assert 0 < found["peak_distance_std_error"] < 0.01
    assert 0 < found["peak_height_std_error"] < 0.05 * found["peak_height"]
    seen = [pair_correlation(gas(rng, n=60, frames=2)).peak for _ in range(20)]
    assert sum(peak["peak_distance"] is not None for peak in seen) <= 1
    assert "nowhere stands out" in seen[0]["reason"]

"""Contact rules against independent oracles: polygon clipping, closed forms, invariances."""

import math

import numba
import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from cellquant.errors import InputError
from cellquant.sim import evaluation
from cellquant.sim.contacts import Layer
from cellquant.sim.initial import initial_state
from cellquant.sim.scene import Scene, SimulationFailure

FREE = {"v0": 0.0, "eta": 0.0, "mu_ab": 1.0, "polydispersity": 0.0}


def polygon(row, radius, modes, n=20000):
    phi = 2 * np.pi * np.arange(n) / n
    a, b = row[3 : 2 + modes], row[2 + modes :]
    r = np.full(n, math.sqrt(1 - 0.5 * (a @ a + b @ b)))
    for m in range(2, modes + 1):
        angle = m * (phi - row[2])
        r += a[m - 2] * np.cos(angle) + b[m - 2] * np.sin(angle)
    points = np.column_stack([np.cos(phi), np.sin(phi)]) * (radius * r)[:, None] + row[:2]
    return shapely.Polygon(points)


def oracle_energy(state, radii, box, modes, eta=0.0, n=20000):
    """Overlap of all pairs and images by polygon clipping, plus tension."""
    shapes = [polygon(row, r, modes, n) for row, r in zip(state, radii, strict=True)]
    total = eta * sum(shape.length for shape in shapes)
    reach = int(np.ceil(4 * max(radii) / min(box))) + 1
    for i, shape in enumerate(shapes):
        for j in range(i, len(shapes)):
            for ix in range(-reach, reach + 1):
                for iy in range(-reach, reach + 1):
                    if i == j and (ix, iy) <= (0, 0):
                        continue
                    moved = shapely.affinity.translate(shapes[j], ix * box[0], iy * box[1])
                    total += shape.intersection(moved).area
    return total


def lively(scene, spread=0.05, seed=0):
    """A state with random shapes and displaced centres."""
    state, radius, box = initial_state(scene)
    rng = np.random.default_rng(seed)
    state[:, :2] += 0.05 * rng.standard_normal((len(state), 2))
    state[:, 3:] = spread * rng.standard_normal(state[:, 3:].shape)
    return state, radius, box


def pair(distance, shapes=((), ()), radii=(0.5, 0.5), modes=6, box=(10.0, 10.0), **changes):
    scene = Scene(
        n_cells=2, box=box, modes=modes, radii=radii, positions=((5, 5), (5 + (distance or 1), 5)),
        polarities=(0.3, 1.1), **{**FREE, **changes},
    )  # fmt: skip
    state, radius, edges = initial_state(scene)
    state[1, 0] = state[0, 0] + distance  # a scene refuses concentric cells; forces must not
    for row, shape in zip(state, shapes, strict=True):
        for mode, a, b in shape:
            row[1 + mode], row[modes + mode] = a, b
    return Layer(scene, radius, edges), state


def velocity(layer, state):
    out = np.full_like(state, np.nan)
    layer.velocity(state, out)
    return out


@pytest.mark.parametrize("n_cells", [1, 4])
@pytest.mark.parametrize("eta", [0.0, 0.05])
def test_forces_are_the_gradient_of_the_clipped_polygon_energy(n_cells, eta):
    scene = Scene(n_cells=n_cells, phi=1.05, **{**FREE, "eta": eta, "polydispersity": 0.1})
    state, radius, box = lively(scene, 0.03, seed=n_cells)
    layer = Layer(scene, radius, box)
    energy = layer.energies(state).sum()
    assert energy == pytest.approx(oracle_energy(state, radius, box, 6, eta), rel=1e-6)
    force = velocity(layer, state)
    rng = np.random.default_rng(1)
    scale = np.abs(force).max()
    for column in rng.choice(state.shape[1], 4, replace=False):
        cell, step = int(rng.integers(n_cells)), 1e-5
        sides = []
        for sign in (1, -1):
            moved = state.copy()
            moved[cell, column] += sign * step
            sides.append(oracle_energy(moved, radius, box, 6, eta))
        expected = -(sides[0] - sides[1]) / (2 * step)
        assert force[cell, column] == pytest.approx(expected, abs=3e-6 * max(scale, 1))


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 10**6), st.floats(0.7, 1.1), st.floats(0.0, 0.04))
def test_forces_are_the_gradient_of_the_energy_and_balance(seed, phi, spread):
    scene = Scene(n_cells=12, phi=phi, seed=seed, **{**FREE, "eta": 0.02})
    state, radius, box = lively(scene, spread, seed)
    layer = Layer(scene, radius, box)
    force = velocity(layer, state)
    assert np.abs(force[:, :2].sum(axis=0)).max() < 1e-14 * len(state)
    rng = np.random.default_rng(seed)
    direction = rng.standard_normal(state.shape)
    step = 1e-7
    ahead = layer.energies(state + step * direction).sum()
    behind = layer.energies(state - step * direction).sum()
    expected = -(ahead - behind) / (2 * step)
    # A contact that opens within the step has an unbounded second derivative.
    assert np.sum(force * direction) == pytest.approx(expected, abs=5e-6)


@settings(deadline=None, max_examples=15)
@given(st.integers(0, 10**6))
def test_exact_rule_finds_every_crossing(seed):
    """Against a dense sampling of the contours: no grazing contact is missed."""
    scene = Scene(n_cells=16, phi=0.97, seed=seed, **FREE)
    state, radius, box = lively(scene, 0.06, seed)
    fine = Layer(scene, radius, box, contact="quadrature", points=20_000)
    coarse = Layer(scene, radius, box)
    assert velocity(coarse, state) == pytest.approx(velocity(fine, state), abs=1.5e-3)


def test_net_torque_balances():
    layer, state = pair(0.85, (((2, 0.1, 0.05), (5, 0.03, 0.0)), ((3, -0.05, 0.08),)))
    out = velocity(layer, state)
    lever = state[1, :2] - state[0, :2]
    assert out[0, :2] == pytest.approx(-out[1, :2], abs=1e-15)
    moment = out[:, 2].sum() + lever[0] * out[1, 1] - lever[1] * out[1, 0]
    assert moment == pytest.approx(0.0, abs=1e-14)


def test_four_crossings():
    # Two peanuts side by side touch with both ends.
    shapes = (((2, -0.45, 0.0),), ((2, -0.45, 0.0),))
    layer, state = pair(0.58, shapes)
    state[:, 2] = 0.0
    out = velocity(layer, state)
    assert (layer._root_last - layer._root_first).max() >= 4
    expected = oracle_energy(state, layer.radius, layer.box, 6)
    assert layer.energies(state).sum() == pytest.approx(expected, rel=1e-6)
    assert out[0, 0] < 0 < out[1, 0]


@pytest.mark.parametrize("radii", [(0.5, 0.15), (0.15, 0.5)])
@pytest.mark.parametrize("offset", [0.0, 0.1, 0.3])
def test_one_cell_inside_another_feels_no_push(radii, offset):
    layer, state = pair(offset, (((2, 0.02, 0.0),), ((3, 0.01, 0.0),)), radii)
    out = velocity(layer, state)
    assert out[:, :3] == pytest.approx(np.zeros((2, 3)), abs=1e-14)
    inner = math.pi * min(radii) ** 2
    assert layer.energies(state).sum() == pytest.approx(inner, rel=1e-12)


def test_coincident_contours_are_one_overlap_of_full_area():
    layer, state = pair(0.0)
    out = velocity(layer, state)
    assert np.isfinite(out).all()
    assert layer.energies(state).sum() == pytest.approx(math.pi * 0.25, rel=1e-9)
    state[1] = state[0]
    state[:, 3:] = 0.03
    out = velocity(layer, state)
    assert np.isfinite(out).all()
    assert layer.energies(state).sum() == pytest.approx(math.pi * 0.25, rel=1e-9)


def test_nearly_inside_and_nearly_coincident():
    for distance in (0.3499999, 0.3500001, 0.35 + 1e-12):
        layer, state = pair(distance, radii=(0.5, 0.15))
        velocity(layer, state)
        assert layer.energies(state).sum() == pytest.approx(math.pi * 0.15**2, rel=1e-4)
    layer, state = pair(1e-6)
    velocity(layer, state)
    assert layer.energies(state).sum() == pytest.approx(math.pi * 0.25 - 1e-6, rel=1e-8)


@pytest.mark.parametrize("depth", [1e-2, 1e-4, 1e-6, 1e-9, 0.0, -1e-9, -1e-3])
def test_tangency_has_the_chord_of_two_circles(depth):
    layer, state = pair(1.0 - depth)
    out = velocity(layer, state)
    distance = 1.0 - depth
    chord = 2 * math.sqrt(max(0.0, 0.25 - 0.25 * distance**2))
    assert out[1, 0] == pytest.approx(chord, rel=1e-6, abs=1e-7)


def test_cell_wrapped_by_the_border_is_the_same_cell():
    layer, state = pair(0.9, (((2, 0.1, 0.0),), ((3, 0.05, 0.0),)), box=(3.0, 2.5))
    before = velocity(layer, state)
    for jump in ((3.0, 0.0), (-6.0, 2.5), (300.0, -250.0)):
        moved = state.copy()
        moved[1, :2] += jump
        fresh, _ = pair(0.9, box=(3.0, 2.5))
        assert velocity(fresh, moved) == pytest.approx(before, abs=1e-12)


@pytest.mark.parametrize("box", [(0.9, 5.0), (0.9, 0.9), (0.45, 3.0)])
def test_one_cell_meets_its_own_images(box):
    scene = Scene(n_cells=1, box=box, radii=(0.5,), **FREE) if box[0] > 0.5 else Scene(
        n_cells=1, box=box, radii=(0.4,), **FREE
    )  # fmt: skip
    state, radius, edges = initial_state(scene)
    layer = Layer(scene, radius, edges)
    out = velocity(layer, state)
    assert out[:, :3] == pytest.approx(np.zeros((1, 3)), abs=1e-13)
    expected = oracle_energy(state, radius, edges, 6, n=4000)
    assert layer.energies(state).sum() == pytest.approx(expected, rel=1e-5)


def test_two_cells_meet_two_images_of_each_other():
    layer, state = pair(0.8, (((2, 0.05, 0.02),), ()), box=(1.7, 4.0))
    assert len(layer.touching(state)) == 2
    expected = oracle_energy(state, layer.radius, layer.box, 6)
    assert layer.energies(state).sum() == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("column", [0, 2, 3])
@pytest.mark.parametrize("contact", ["exact", "quadrature"])
def test_numbers_that_are_none_are_refused(column, contact):
    layer, state = pair(3.0)
    layer = Layer(layer.scene, layer.radius, layer.box, contact=contact)
    velocity(layer, state)
    state[1, column] = np.nan
    with pytest.raises(SimulationFailure, match="finite in cell 1") as caught:
        velocity(layer, state)
    assert caught.value.cell == 1
    assert caught.value.remedy


def test_quadrature_converges_to_the_exact_rule():
    scene = Scene(n_cells=16, phi=1.0, **{**FREE, "eta": 0.03})
    state, radius, box = lively(scene)
    exact = velocity(Layer(scene, radius, box), state)
    errors = []
    for points in (40, 400, 4000):
        rule = Layer(scene, radius, box, contact="quadrature", points=points)
        errors.append(np.sqrt(np.mean((velocity(rule, state) - exact) ** 2)))
    assert errors[0] > 5 * errors[1] > 25 * errors[2] > 0
    assert errors[2] < 3e-3 * np.sqrt(np.mean(exact**2))


@pytest.mark.parametrize(
    ("modes", "spread", "seeds"),
    [
        (6, 0.1, [1]),
        pytest.param(12, 0.06, range(6), marks=pytest.mark.slow),
        pytest.param(24, 0.03, range(4), marks=pytest.mark.slow),
    ],
)
def test_no_contact_of_rough_contours_is_missed(modes, spread, seeds):
    """Lenses between two samples, which the interpolation through them does not show."""
    scene = Scene(n_cells=36, phi=1.1, modes=modes, **FREE)
    for seed in seeds:
        state, radius, box = lively(scene, spread, seed)
        fine = Layer(scene, radius, box, contact="quadrature", points=20_000)
        exact = velocity(Layer(scene, radius, box), state)
        assert np.abs(exact - velocity(fine, state)).max() < 2.5e-3


def test_quadrature_of_forty_points_is_the_published_sum():
    """A plain loop over points and neighbours, as the rule is written."""
    scene = Scene(n_cells=9, phi=1.0, **FREE)
    state, radius, box = lively(scene)
    out = velocity(Layer(scene, radius, box, contact="quadrature", points=40), state)
    shapes = [polygon(row, r, 6, 20000) for row, r in zip(state, radius, strict=True)]
    phi = 2 * np.pi * np.arange(40) / 40
    for i, row in enumerate(state):
        a, b = row[3:8], row[8:]
        n = np.arange(2, 7)[:, None]
        angle = n * (phi - row[2])
        rho = radius[i] * (
            math.sqrt(1 - 0.5 * (a @ a + b @ b)) + a @ np.cos(angle) + b @ np.sin(angle)
        )
        slope = radius[i] * (b @ (n * np.cos(angle)) - a @ (n * np.sin(angle)))
        held = np.zeros(40)
        for j, shape in enumerate(shapes):
            for ix in (-1, 0, 1):
                for iy in (-1, 0, 1):
                    if j == i and ix == iy == 0:
                        continue
                    x = row[0] + rho * np.cos(phi) - ix * box[0]
                    y = row[1] + rho * np.sin(phi) - iy * box[1]
                    held += shapely.contains_xy(shape, x, y)
        normal_x = slope * np.sin(phi) + rho * np.cos(phi)
        assert out[i, 0] == pytest.approx(-np.sum(held * normal_x) * 2 * np.pi / 40, abs=1e-12)
        torque = np.sum(held * rho * slope) * 2 * np.pi / 40
        assert out[i, 2] == pytest.approx(torque, abs=1e-12)


@pytest.mark.parametrize("contact", ["exact", "quadrature"])
def test_forces_depend_on_no_number_of_parts_and_on_nothing_left_in_work_arrays(
    contact, monkeypatch
):
    """Bit for bit, where each block of cells is a part of its own and work arrays hold garbage."""
    scene = Scene(phi=0.85, n_cells=600)
    rng = np.random.default_rng(1)
    for seed in range(6):
        state, radius, box = lively(scene, seed=seed)
        alone = velocity(Layer(scene, radius, box, contact=contact), state)
        layer = Layer(scene, radius, box, contact=contact)
        monkeypatch.setattr(numba, "get_num_threads", lambda: 100)
        velocity(layer, state)
        for array in getattr(layer, "_work", ()):
            if array.dtype.kind == "f":
                array[...] = rng.normal(size=array.shape)
        in_parts = velocity(layer, state)
        monkeypatch.undo()
        assert np.array_equal(in_parts, alone)


@pytest.fixture
def reached(monkeypatch):
    """How far every evaluation at one go came."""
    outcomes = []
    evaluate = evaluation.evaluate

    def noted(*arguments):
        outcomes.append(evaluate(*arguments))
        return outcomes[-1]

    monkeypatch.setattr(evaluation, "evaluate", noted)
    return outcomes


@pytest.mark.parametrize("contact", ["exact", "quadrature"])
def test_what_is_done_at_one_go_equals_what_is_done_step_by_step(contact, reached):
    """Bit for bit, also where the list has aged and where a contour is pinched."""
    scene = Scene(phi=1.0, n_cells=100)
    state, radius, box = lively(scene)
    far = state.copy()
    far[:, :2] += np.random.default_rng(3).normal(scale=0.3, size=(100, 2))
    pinched = far.copy()
    pinched[7, 3:], pinched[7, 3] = 0.0, 0.75
    at_one_go, by_steps = (Layer(scene, radius, box, contact=contact) for _ in range(2))
    for row in (state, state, far, far, pinched, far):
        by_steps._at_one_go = ()
        assert np.array_equal(velocity(at_one_go, row), velocity(by_steps, row))
    everything, outlines = evaluation.ALL, evaluation.OUTLINES
    assert reached == [everything, outlines, everything, outlines, everything]


def test_more_crossings_than_there_was_room_for_are_found(reached):
    scene = Scene(phi=1.0, n_cells=100)
    state, radius, box = lively(scene)
    circles = state.copy()
    circles[:, 3:] = 0.0
    layer = Layer(scene, radius, box)
    expected = velocity(layer, state)
    velocity(layer, circles)
    _, first, _, begin, end, _ = layer.crossings
    in_blocks = np.add.reduceat(end - begin, first[:-1:32])
    layer._allocate_roots(in_blocks.max() + 2)
    velocity(layer, circles)
    reached.clear()
    assert np.array_equal(velocity(layer, state), expected)
    assert reached == [evaluation.NOTHING]


@pytest.mark.parametrize("contact", ["exact", "quadrature"])
def test_absent_terms_change_nothing(contact):
    plain = Scene(n_cells=30, phi=1.0, **{**FREE, "mu_theta": 0.0})
    state, radius, box = lively(plain)
    lean = velocity(Layer(plain, radius, box, contact=contact), state)
    full = velocity(Layer(plain, radius, box, contact=contact, general=True), state)
    # Guesses in single precision may round in another way; crossings are settled to 1e-9.
    assert lean == pytest.approx(full, abs=1e-11)
    assert not lean[:, 2].any()


def test_rigid_discs_equal_the_general_kernel_without_shapes():
    general = Scene(n_cells=30, phi=0.9, **{**FREE, "polydispersity": 0.2})
    state, radius, box = lively(general, 0.0)
    discs = general.replace(modes=1)
    layer = Layer(discs, radius, box)
    out = velocity(layer, np.ascontiguousarray(state[:, :3]))
    whole = Layer(general, radius, box)
    assert out[:, :2] == pytest.approx(velocity(whole, state)[:, :2], abs=1e-10)
    energies = layer.energies(np.ascontiguousarray(state[:, :3]))
    assert energies.sum() == pytest.approx(whole.energies(state).sum(), rel=1e-10)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("phi", 0.0), ("phi", -1.0), ("phi", 2.5), ("phi", math.nan), ("v0", -0.1),
        ("eta", math.inf), ("n_cells", 0), ("n_cells", 2.5), ("polydispersity", 0.4),
        ("D_r", -1e-9), ("mu_r", 0.0), ("modes", 0), ("modes", 99), ("initial", "square"),
        ("box", (1.0, 0.0)), ("box", (3.0, 3.0)), ("seed", -1), ("radii", (0.5,)),
        ("positions", ((0.0, math.nan),) * 1024), ("positions", ((1.0, 1.0),) * 1024),
        ("aspect", 0.0), ("phi", "dense"),
    ],
)  # fmt: skip
def test_impossible_scenes_are_refused_by_field(field, value):
    with pytest.raises(InputError, match=field):
        Scene(**{field: value})


def test_scene_survives_its_dictionary():
    scene = Scene(n_cells=2, radii=np.array([0.5, 0.4]), box=(4, 5), positions=np.eye(2))
    assert Scene.from_dict(scene.to_dict()) == scene
    assert hash(scene) == hash(scene.replace())


@pytest.mark.parametrize("n_cells", [1, 2, 3, 4, 5, 7, 16, 100, 144])
def test_lattice_fills_the_box_evenly(n_cells):
    scene = Scene(n_cells=n_cells, phi=0.9, polydispersity=0.0)
    state, radius, box = initial_state(scene)
    assert np.sum(math.pi * radius**2) / np.prod(box) == pytest.approx(0.9)
    assert len(np.unique(np.round(state[:, :2] % box, 9), axis=0)) == n_cells

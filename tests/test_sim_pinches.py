"""Cells whose contour reaches its centre: energy, forces and runs go on."""

import itertools
import math

import numpy as np
import pytest
import shapely
from scipy.integrate import quad
from scipy.optimize import brentq

from cellquant.sim.contacts import Layer
from cellquant.sim.initial import initial_state
from cellquant.sim.scene import Scene

MODES = 6


def waves(row, phi):
    """R / R0 of a contour less its mean a0."""
    orders = np.arange(2, MODES + 1)[:, None]
    angle = orders * (phi - row[2])
    return row[3 : 2 + MODES] @ np.cos(angle) + row[2 + MODES :] @ np.sin(angle)


def mean_radius(row, n=100_000):
    """The a0 for which the set r < R has the area pi R0^2, by bisection on dense samples."""
    wave = waves(row, 2 * np.pi * np.arange(n) / n)
    return brentq(lambda a0: np.mean(np.maximum(a0 + wave, 0.0) ** 2) - 1.0, -9, 9, xtol=1e-15)


def star(row, radius, n=6000):
    """The set r < R(phi) as a polygon: no extent where R <= 0."""
    phi = 2 * np.pi * np.arange(n) / n
    r = np.maximum(mean_radius(row) + waves(row, phi), 1e-9)
    return shapely.Polygon(np.column_stack([np.cos(phi), np.sin(phi)]) * (radius * r)[:, None])


def overlap_energy(state, radius, box):
    shapes = [star(row, r) for row, r in zip(state, radius, strict=True)]
    images = [box * (x, y) for x in (-1, 0, 1) for y in (-1, 0, 1)]
    total = 0.0
    for i, shape in enumerate(shapes):
        for j, other in enumerate(shapes[: i + 1]):
            apart = state[j, :2] - state[i, :2]
            apart -= np.round(apart / box) * box
            for shift in images if j < i else images[:4]:
                moved = shapely.affinity.translate(other, *(apart + shift))
                total += shape.intersection(moved).area
    return total


def layer_with_pinches(seed, eta=0.0, waist=-0.1):
    """A dense layer in which some cells have a closed waist, in random directions."""
    scene = Scene(n_cells=9, phi=1.0, v0=0.0, eta=eta, mu_ab=1.0, seed=seed)
    state, radius, box = initial_state(scene)
    rng = np.random.default_rng(seed)
    state[:, :2] += 0.08 * rng.standard_normal((9, 2))
    state[:, 3:] = 0.03 * rng.standard_normal(state[:, 3:].shape)
    for cell in (0, 4):
        phi = np.linspace(0, 2 * np.pi, 721)
        for size in np.linspace(0.5, 3.0, 400):  # the elongation at which the waist is as deep
            state[cell, 3] = size
            if mean_radius(state[cell], 4000) + waves(state[cell], phi).min() < waist:
                break
        state[cell, 2] = rng.uniform(0, 2 * np.pi)
    return Layer(scene, radius, box), state, radius, box


def velocity(layer, state):
    out = np.empty_like(state)
    layer.velocity(state, out)
    return out


@pytest.mark.parametrize("waist", [0.05, 1e-3, -1e-3, -0.02, -0.1, -0.3])
def test_overlap_of_pinched_cells_is_that_of_their_star_shaped_sets(waist):
    for seed in range(2):
        layer, state, radius, box = layer_with_pinches(seed, waist=waist)
        expected = overlap_energy(state, radius, box)
        assert layer.energies(state).sum() == pytest.approx(expected, abs=3e-6)


@pytest.mark.parametrize("waist", [0.05, 1e-3, -1e-3, -0.1])
def test_forces_of_pinched_cells_are_the_gradient_of_their_energy(waist):
    for seed in range(3):
        layer, state, _, _ = layer_with_pinches(seed, eta=0.05, waist=waist)
        force = velocity(layer, state)
        assert np.abs(force[:, :2].sum(axis=0)).max() < 1e-13
        rng = np.random.default_rng(seed)
        for _ in range(4):
            direction = rng.standard_normal(state.shape)
            step = 1e-7
            ahead = layer.energies(state + step * direction).sum()
            behind = layer.energies(state - step * direction).sum()
            expected = -(ahead - behind) / (2 * step)
            assert np.sum(force * direction) == pytest.approx(expected, abs=2e-6)


def test_energy_has_no_kink_where_a_waist_closes():
    """Force along the closing waist, from an open to a closed one: no jump."""
    layer, state, _, _ = layer_with_pinches(3, eta=0.05, waist=0.0)
    push = []
    for shift in np.linspace(-2e-3, 2e-3, 81):
        moved = state.copy()
        moved[[0, 4], 3] += shift
        push.append(velocity(layer, moved)[[0, 4], 3:].ravel())
    jumps = np.abs(np.diff(push, axis=0)).max(axis=1)
    assert jumps.max() < 4 * np.median(jumps) + 1e-4


def test_fine_quadrature_converges_to_the_exact_rule_for_pinched_cells():
    layer, state, radius, box = layer_with_pinches(2, eta=0.02, waist=-0.15)
    fine = Layer(layer.scene, radius, box, contact="quadrature", points=10_000)
    difference = velocity(layer, state) - velocity(fine, state)
    assert np.abs(difference).max() < 1e-3


@pytest.mark.parametrize(("waist", "limit"), [(0.6, 1e-9), (0.1, 1e-5), (-0.05, 1e-7)])
def test_shapes_against_adaptive_quadrature(waist, limit):
    from cellquant.sim.shapes import contours, mean_radii, measure_shapes, pinched

    _, state, radius, _ = layer_with_pinches(5, waist=waist)
    modes = state[:, 3:].reshape(len(state), 2, -1)
    found = measure_shapes(modes, state[:, 2], radius)
    n = np.arange(2, MODES + 1)
    means = mean_radii(modes)
    for cell, row in enumerate(state):
        a0 = mean_radius(row)
        assert means[cell] == pytest.approx(a0, abs=1e-9)
        a, b = modes[cell]

        def reach(phi, row=row, a0=a0):
            return a0 + float(waves(row, np.array([phi + row[2]]))[0])

        def stretch(phi, a=a, b=b, reach=reach):
            return math.hypot(reach(phi), n @ (b * np.cos(n * phi) - a * np.sin(n * phi)))

        grid = np.linspace(0, 2 * np.pi, 721)
        signs = np.sign([reach(phi) for phi in grid])
        zeros = [brentq(reach, grid[k], grid[k + 1]) for k in np.flatnonzero(np.diff(signs))]
        ends = [0.0, *zeros, 2 * np.pi]
        length = sum(
            quad(stretch, *pair, limit=2000, epsabs=1e-11)[0]
            for pair in itertools.pairwise(ends)
            if reach(sum(pair) / 2) > 0
        )
        assert found["shape_index"][cell] == pytest.approx(length / math.sqrt(math.pi), rel=limit)
        assert found["area"][cell] == pytest.approx(math.pi * radius[cell] ** 2, rel=1e-12)
    closed = pinched(modes)
    assert closed.tolist() == [waist < 0 and cell in (0, 4) for cell in range(9)]
    outline = contours(state[:, :2], modes, state[:, 2], radius)
    reach = np.linalg.norm(outline - state[:, None, :2], axis=2).min(axis=1)
    assert ((reach == 0.0) == closed).all()


def test_every_shape_has_a_mean_radius_and_keeps_its_area():
    """Also where the closed form has none; its derivative is that of the area of the set."""
    from cellquant.sim.shapes import contours, mean_radii

    rng = np.random.default_rng(1)
    modes = rng.standard_normal((40, 2, MODES - 1)) * np.linspace(0.05, 2.0, 40)[:, None, None]
    zero, one = np.zeros(40), np.ones(40)
    outlines = contours(np.zeros((40, 2)), modes, zero, one, 20_000)
    areas = shapely.area(shapely.polygons(outlines))
    assert areas == pytest.approx(np.full(40, np.pi), rel=1e-5)
    assert (mean_radii(modes[20:]) < 0).any()  # the mean of R may be negative
    closed = np.sqrt(1 - 0.5 * np.sum(modes[:2] ** 2, axis=(1, 2)))
    assert mean_radii(modes)[:2] == pytest.approx(closed, rel=1e-15)


@pytest.mark.parametrize("contact", ["exact", "quadrature"])
def test_a_cell_beyond_the_closed_form_is_pushed_back(contact):
    """a0^2 <= 0 in the closed form, which ended runs: force and energy are as for any shape."""
    layer, state, radius, box = layer_with_pinches(1, eta=0.05, waist=-0.3)
    state[0, 3:] *= 1.7
    state[4, 3:] *= 1.4
    assert 0.5 * np.sum(state[0, 3:] ** 2) > 1.0
    expected = overlap_energy(state, radius, box)
    tensionless = Layer(layer.scene.replace(eta=0.0), radius, box)
    assert tensionless.energies(state).sum() == pytest.approx(expected, abs=1e-5)
    rule = Layer(layer.scene, radius, box, contact=contact, points=20_000)
    force = velocity(rule, state)
    rng = np.random.default_rng(0)
    for _ in range(4):
        direction = rng.standard_normal(state.shape)
        step = 1e-6
        ahead = layer.energies(state + step * direction).sum()
        behind = layer.energies(state - step * direction).sum()
        tolerance = 1e-5 if contact == "exact" else 3e-3
        slope = -(ahead - behind) / (2 * step)
        assert np.sum(force * direction) == pytest.approx(slope, abs=tolerance)


@pytest.mark.parametrize("seed", [2, *(pytest.param(k, marks=pytest.mark.slow) for k in (0, 1, 3))])
def test_a_passive_layer_opens_closed_waists_and_its_energy_never_rises(seed):
    """In short steps a rise is a contact that the search of crossings missed for a moment."""
    from cellquant.sim.integrators import METHODS
    from cellquant.sim.shapes import pinched

    layer, state, radius, box = layer_with_pinches(seed, eta=0.05, waist=-0.3)
    still = Layer(layer.scene.replace(D_r=0.0), radius, box)
    method = METHODS["euler"].make(still)
    zero = np.zeros(len(state))
    closed = [pinched(state[:, 3:].reshape(len(state), 2, -1)).sum()]
    energy = [still.energies(state).sum()]
    for _ in range(10_000):
        method.step(state, 0.0005, zero, zero)
        energy.append(still.energies(state).sum())
    closed.append(pinched(state[:, 3:].reshape(len(state), 2, -1)).sum())
    assert closed == [2, 0]
    assert np.diff(energy).max() <= 0.0

"""Cells whose contour reaches its centre: energy, forces and runs go on."""

import math

import numpy as np
import pytest
import shapely

from cellquant.sim.contacts import Layer
from cellquant.sim.initial import initial_state
from cellquant.sim.scene import Scene

MODES = 6


def star(row, radius, n=6000):
    """The set r < R(phi) as a polygon: no extent where R <= 0."""
    phi = 2 * np.pi * np.arange(n) / n
    a, b = row[3 : 2 + MODES], row[2 + MODES :]
    r = np.full(n, math.sqrt(1 - 0.5 * (a @ a + b @ b)))
    for m in range(2, MODES + 1):
        angle = m * (phi - row[2])
        r += a[m - 2] * np.cos(angle) + b[m - 2] * np.sin(angle)
    r = np.maximum(r, 1e-9)
    return shapely.Polygon(np.column_stack([np.cos(phi), np.sin(phi)]) * (radius * r)[:, None])


def overlap_energy(state, radius, box):
    shapes = [star(row, r) for row, r in zip(state, radius, strict=True)]
    total = 0.0
    for i, shape in enumerate(shapes):
        for j in range(i + 1, len(shapes)):
            apart = state[j, :2] - state[i, :2]
            apart -= np.round(apart / box) * box
            total += shape.intersection(shapely.affinity.translate(shapes[j], *apart)).area
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
        for size in np.linspace(0.5, 1.0, 400):  # the elongation at which the waist is as deep
            state[cell, 3] = size
            power = 0.5 * np.sum(state[cell, 3:] ** 2)
            r = math.sqrt(1 - power) + sum(
                state[cell, 1 + m] * np.cos(m * phi) + state[cell, MODES + m] * np.sin(m * phi)
                for m in range(2, MODES + 1)
            )
            if r.min() < waist:
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


@pytest.mark.parametrize(("waist", "limit"), [(0.6, 1e-9), (0.1, 1e-5), (-0.05, 2e-4)])
def test_shape_index_against_adaptive_quadrature(waist, limit):
    from scipy.integrate import quad

    from cellquant.sim.shapes import contours, measure_shapes, pinched

    _, state, radius, _ = layer_with_pinches(5, waist=waist)
    modes = state[:, 3:].reshape(len(state), 2, -1)
    found = measure_shapes(modes, state[:, 2], radius)["shape_index"]
    n = np.arange(2, MODES + 1)
    for cell in range(len(state)):
        a, b = modes[cell]
        a0 = math.sqrt(1 - 0.5 * (a @ a + b @ b))

        def stretch(phi, a=a, b=b, a0=a0):
            c, s = np.cos(n * phi), np.sin(n * phi)
            return math.hypot(a0 + a @ c + b @ s, n @ (b * c - a * s))

        length, _ = quad(stretch, 0, 2 * np.pi, limit=2000, epsabs=1e-11)
        assert found[cell] == pytest.approx(length / math.sqrt(math.pi), rel=limit)
    closed = pinched(modes, state[:, 2], radius)
    assert closed.tolist() == [waist < 0 and cell in (0, 4) for cell in range(9)]
    outline = contours(state[:, :2], modes, state[:, 2], radius)
    reach = np.linalg.norm(outline - state[:, None, :2], axis=2).min(axis=1)
    assert ((reach == 0.0) == closed).all()

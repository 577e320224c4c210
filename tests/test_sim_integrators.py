"""Integrators: measured strong and weak orders, the stiff part, steps that follow a tolerance."""

import math

import numpy as np
import pytest

from cellquant.errors import InputError
from cellquant.sim import Scene, SimulationFailure, simulate
from cellquant.sim.contacts import Layer
from cellquant.sim.initial import initial_state
from cellquant.sim.integrators import METHODS, Implicit, Rosenbrock, Sra1, recommended
from cellquant.sim.noise import BrownianTree
from cellquant.sim.steps import AdaptiveSteps, Plan
from cellquant.sim.stiffness import StiffPart

WALKERS = Scene(
    n_cells=1500, phi=0.0002, v0=0.5, D_r=0.5, modes=2, eta=0.0, polydispersity=0.0, seed=4
)
SPAN = 2.0


def end_state(make, scene, start, radius, box, tree, depth):
    method = make(Layer(scene, radius, box))
    state = start.copy()
    w, area = tree.level(0, depth)
    for index in range(2**depth):
        method.step(state, tree.span / 2**depth, w[index], area[index])
    return state


def slope(errors):
    """Order from errors at successively halved steps."""
    return -np.polyfit(np.arange(len(errors)), np.log2(np.abs(errors)), 1)[0]


class Walkers:
    """Free active Brownian particles, whose displacement is an integral of their path."""

    def __init__(self):
        self.start, self.radius, self.box = initial_state(WALKERS)
        self.tree = BrownianTree(5, WALKERS.n_cells, SPAN)
        # v0 times the integral of (cos, sin) theta, on 2^11 parts, from the path alone.
        w, area = self.tree.level(0, 11)
        noise = math.sqrt(2 * WALKERS.D_r)
        begin = self.start[:, 2] + noise * (np.cumsum(w, axis=0) - w)
        middle = begin + noise * (0.5 * w + area)
        spread = 1 - 0.5 * noise**2 * (w**2 / 12 + area**2 / 5 + SPAN / 2**11 / 30)
        directions = np.stack([np.cos(middle) * spread, np.sin(middle) * spread], axis=2)
        self.exact = WALKERS.v0 * SPAN / 2**11 * directions.sum(axis=0)

    def displacement(self, make, depth):
        end = end_state(make, WALKERS, self.start, self.radius, self.box, self.tree, depth)
        return end[:, :2] - self.start[:, :2]

    def strong_order(self, make, depths=(2, 3, 4, 5)):
        apart = [self.displacement(make, depth) - self.exact for depth in depths]
        return slope([np.sqrt(np.mean(error**2)) for error in apart])

    def weak_order(self, make, depths=(0, 1, 2, 3)):
        """Of the mean displacement along the first polarity, on common paths."""
        along = np.stack([np.cos(self.start[:, 2]), np.sin(self.start[:, 2])], axis=1)
        apart = [self.displacement(make, depth) - self.exact for depth in depths]
        return slope([np.mean(np.sum(error * along, axis=1)) for error in apart])


@pytest.fixture(scope="module")
def walkers():
    return Walkers()


def test_exact_displacements_have_the_moments_of_the_persistent_walk(walkers):
    """MSD = 2 (v0/D)^2 (D t - 1 + exp(-D t)); mean = v0 (1 - exp(-D t)) / D along the polarity."""
    rate, speed = WALKERS.D_r, WALKERS.v0
    squares = np.sum(walkers.exact**2, axis=1)
    x = rate * SPAN
    expected = 2 * (speed / rate) ** 2 * (x - 1 + np.exp(-x))
    assert squares.mean() == pytest.approx(expected, abs=4 * squares.std() / np.sqrt(1500))
    theta = walkers.start[:, 2]
    along = walkers.exact[:, 0] * np.cos(theta) + walkers.exact[:, 1] * np.sin(theta)
    expected = speed * (1 - np.exp(-x)) / rate
    assert along.mean() == pytest.approx(expected, abs=4 * along.std() / np.sqrt(1500))


@pytest.mark.parametrize(
    ("name", "strong", "weak"),
    [("euler", 1.0, 1.0), ("implicit", 1.0, 1.0), ("sra1", 1.5, 2.0), ("rosenbrock", 1.5, 2.0)],
)
def test_measured_orders_of_free_walkers(walkers, name, strong, weak):
    make = METHODS[name].make
    assert walkers.strong_order(make) == pytest.approx(strong, abs=0.15)
    assert walkers.weak_order(make) == pytest.approx(weak, abs=0.4)


class BlindToTheArea(Sra1):
    """Broken on purpose: the integral of the path is left out."""

    def step(self, state, h, w, area):
        super().step(state, h, w, 0.0 * area)


class TurnedTwice(Rosenbrock):
    """Broken on purpose: both looks at the path see its end."""

    def step(self, state, h, w, area):
        before = state[:, 2].copy()
        state[:, 2] += 0.5 * self._noise * w
        super().step(state, h, w, area)
        state[:, 2] = before + self._noise * w


@pytest.mark.parametrize("broken", [BlindToTheArea, TurnedTwice])
def test_a_broken_integrator_fails_the_measurement_of_the_order(walkers, broken):
    with pytest.raises(AssertionError):
        assert walkers.strong_order(broken) == pytest.approx(1.5, abs=0.15)


@pytest.mark.parametrize(
    ("name", "order"), [("euler", 1.0), ("implicit", 1.0), ("rosenbrock", 2.0)]
)
def test_orders_without_noise_in_a_pressed_pair(name, order):
    """Two cells driven against each other, in contact all the time."""
    scene = Scene(
        n_cells=2, box=(6, 6), radii=(0.5, 0.45), positions=((2, 3), (2.85, 3.1)),
        polarities=(0.3, 2.5), v0=0.1, D_r=0.0, mu_ab=0.5, eta=0.05,
    )  # fmt: skip
    start, radius, box = initial_state(scene)
    tree = BrownianTree(1, 2, 0.25)
    exact = end_state(METHODS["sra1"].make, scene, start, radius, box, tree, 12)
    errors = [
        np.abs(end_state(METHODS[name].make, scene, start, radius, box, tree, d) - exact).max()
        for d in (7, 8, 9)
    ]
    assert slope(errors) == pytest.approx(order, abs=0.3)


@pytest.fixture(scope="module")
def dense():
    """A settled dense layer with its converged end on one path, by an explicit method."""
    scene = Scene(n_cells=36, seed=2)
    state, radius, box = initial_state(scene)
    settle = BrownianTree(8, 36, 0.1)
    method = Implicit(Layer(scene, radius, box))
    for root in range(200):
        w, area = settle.level(root, 0)
        method.step(state, 0.1, w[0], area[0])
    tree = BrownianTree(9, 36, 1.0)
    exact = end_state(METHODS["sra1"].make, scene, state, radius, box, tree, 11)
    return scene, state, radius, box, tree, exact


def distance(a, b):
    return np.sqrt(np.mean(np.sum((a[:, :2] - b[:, :2]) ** 2, axis=1)))


@pytest.mark.parametrize(("name", "least"), [("implicit", 0.75), ("rosenbrock", 1.0)])
def test_stiff_layers_converge_to_the_explicit_reference(dense, name, least):
    scene, start, radius, box, tree, exact = dense
    make = METHODS[name].make
    errors = [
        distance(end_state(make, scene, start, radius, box, tree, d), exact) for d in (2, 3, 5, 7)
    ]
    assert errors[0] < 1e-2
    assert errors[-1] < 5e-4
    assert slope(errors[1:]) / 2 > least


def test_one_evaluation_a_step_beats_the_published_scheme(dense):
    """At a step thirty times as long."""
    scene, start, radius, box, tree, exact = dense
    layer = Layer(scene, radius, box, contact="quadrature")
    published = METHODS["euler"].make(layer)
    state = start.copy()
    w, area = tree.level(0, 8)
    for index in range(2**8):
        published.step(state, 1 / 2**8, w[index], area[index])
    quick = Layer(scene, radius, box)
    end = end_state(lambda _: Implicit(quick), scene, start, radius, box, tree, 3)
    assert quick.evaluations == 8
    assert distance(end, exact) < distance(state, exact)


def test_stiff_part_is_the_slope_of_the_push_in_a_shallow_contact():
    scene = Scene(
        n_cells=2, box=(8, 8), radii=(0.5, 0.5), positions=((3, 4), (3.999, 4)),
        polarities=(0.4, 1.0), mu_ab=0.3, eta=0.0,
    )  # fmt: skip
    state, radius, box = initial_state(scene)
    layer = Layer(scene, radius, box)
    out, shifted = np.empty_like(state), np.empty_like(state)
    layer.velocity(state, out)
    stiff = StiffPart(layer)
    stiff.collect()
    nothing = np.zeros_like(stiff.tension, dtype=np.float32)
    # (1 + g A) (d + g A d) = (1 + g A)^2 d: recover A d from a solve with a tiny g.
    direction = np.zeros_like(state)
    direction[0, 0] = 1.0
    moved = state + 1e-6 * direction
    layer.velocity(moved, shifted)
    slope_of_push = (out - shifted) / 1e-6
    solved = np.empty_like(state)
    stiff.solve(state, direction + 1e-2 * slope_of_push, 1e-2, nothing, solved)
    layer.velocity(state, out)
    assert np.abs(solved - direction).max() < 0.06
    assert slope_of_push[0, 0] > 10


def test_solve_agrees_with_a_dense_matrix(dense, monkeypatch):
    scene, state, radius, box, _, _ = dense
    monkeypatch.setattr("cellquant.sim.stiffness.CG_TOLERANCE", 1e-5)
    layer = Layer(scene, radius, box)
    drift = np.empty_like(state)
    layer.velocity(state, drift)
    stiff = StiffPart(layer)
    stiff.collect()
    n, columns = state.shape
    width = stiff.tension.shape[1]
    count = stiff._count
    weight = np.zeros((count, n, width))
    rows = np.arange(count)
    weight[rows, stiff._cells[:count, 0]] += stiff._weight[:count, :width]
    weight[rows, stiff._cells[:count, 1]] += stiff._weight[:count, width:]
    weight = weight[:, :, :columns].reshape(count, -1)
    scale = np.tile(stiff._scale, n)
    tension = 0.1 * stiff.tension
    g = 0.3
    dense_matrix = np.eye(n * columns) + np.diag(tension[:, :columns].ravel())
    dense_matrix += g * (weight.T * stiff._factor[:count]) @ weight
    # The modes of the matrix stand in the frame of the laboratory.
    modes = np.arange(2, scene.modes + 1)
    phase = np.exp(1j * np.outer(state[:, 2], modes))

    def turned(x, phase):
        pair = (x[:, 3 : 2 + scene.modes] + 1j * x[:, 2 + scene.modes :]) * phase
        return np.hstack([x[:, :3], pair.real, pair.imag])

    right = turned(drift, phase).ravel() / scale
    expected = (scale * np.linalg.solve(dense_matrix, right)).reshape(n, columns)
    out = np.empty_like(state)
    stiff.solve(state, drift, g, tension.astype(np.float32), out)
    assert turned(out, phase) == pytest.approx(expected, abs=1e-4 * np.abs(expected).max())
    drift[3, 1] = np.nan
    stiff.solve(state, drift, g, tension.astype(np.float32), out)
    assert np.isnan(out).all()


def test_short_steps_leave_the_linear_algebra_out(dense):
    scene, start, radius, box, tree, _ = dense
    layer = Layer(scene, radius, box)
    method = Implicit(layer)
    state = start.copy()
    w, area = tree.level(0, 10)
    method.step(state, 2.0**-10, w[0], area[0])
    drift = np.empty_like(start)
    middle = start.copy()
    turned = math.sqrt(2 * scene.D_r)
    middle[:, 2] += turned * (0.5 * w[0] + area[0])
    layer.velocity(middle, drift)
    expected = start + 2.0**-10 * drift
    expected[:, 2] += turned * w[0]
    assert state == pytest.approx(expected, abs=1e-15)
    assert method._stiff.iterations == 0


def test_noiseless_scenes_draw_no_noise(monkeypatch):
    def refuse(*args):
        raise AssertionError("noise was drawn")

    monkeypatch.setattr(BrownianTree, "level", refuse)
    for integrator in ("euler", "implicit", "rosenbrock"):
        simulate(Scene(n_cells=4, D_r=0.0), duration=1, dt=0.1, integrator=integrator)
    simulate(Scene(n_cells=4, D_r=0.0), duration=1, tolerance=1e-2)
    with pytest.raises(AssertionError, match="noise"):
        simulate(Scene(n_cells=4, D_r=0.1), duration=1, dt=0.1)


def test_the_scene_chooses_its_method():
    assert recommended(Scene(), "exact") == "implicit"
    assert recommended(Scene(), "quadrature") == "euler"
    assert recommended(Scene(modes=1), "exact") == "euler"
    for name in ("implicit", "rosenbrock"):
        with pytest.raises(InputError, match="choose integrator euler"):
            simulate(Scene(modes=1, n_cells=4), duration=1, integrator=name)


def adaptive_end(dense, tolerance):
    scene, start, radius, box, tree, _ = dense
    steps = AdaptiveSteps(Layer(scene, radius, box), Plan(1.0, 1, 0, 2), tolerance, tree)
    state = start.copy()
    steps.advance(state, 0)
    return state, steps


def test_adaptive_errors_follow_the_tolerance(dense):
    loose, few = adaptive_end(dense, 3e-3)
    tight, many = adaptive_end(dense, 1e-4)
    exact = dense[-1]
    assert many.count > 2 * few.count
    assert distance(tight, exact) < 0.3 * distance(loose, exact)
    assert distance(loose, exact) < 1e-2


def test_adaptive_retries_are_bounded_and_keep_what_was_reached():
    scene = Scene(n_cells=9, phi=0.9)
    with pytest.raises(SimulationFailure, match="raise the tolerance") as caught:
        simulate(scene, duration=3, tolerance=1e-13)
    assert caught.value.run.n_frames == 1
    assert caught.value.run.work["rejected"] < 40

"""Time steps of the layer: additive noise on the polarities, stiff contacts.

Every method advances a state in place over one step, given the increment W and the area H of the
Brownian path of every cell over the step (see `noise`).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cellquant.errors import InputError
from cellquant.sim.contacts import Layer
from cellquant.sim.scene import Scene
from cellquant.sim.stiffness import StiffPart

Floats = NDArray[np.float64]


class Integrator(Protocol):
    """One method, bound to a layer."""

    def step(self, state: Floats, h: float, w: Floats, area: Floats) -> None:
        """Advance `state` by h, with increments w (N,) and areas (N,) of the Brownian paths."""

    def restart(self) -> None:
        """Forget earlier steps, so that a resumed run goes on as one that never stopped."""


class Euler:
    """Euler-Maruyama, the published scheme: strong order 1, for h below 2 / stiffness."""

    def __init__(self, layer: Layer) -> None:
        self._layer = layer
        self._noise = math.sqrt(2.0 * layer.scene.D_r)
        self._slope = np.empty((len(layer.radius), layer.n_columns))

    def restart(self) -> None:
        """Nothing is remembered from step to step."""

    def step(self, state: Floats, h: float, w: Floats, area: Floats) -> None:
        """Advance by one evaluation."""
        self._layer.velocity(state, self._slope)
        self._slope *= h
        state += self._slope
        state[:, 2] += self._noise * w


class Sra1:
    """SRA1: strong order 1.5 for additive noise where the drift is smooth; two evaluations.

    References
    ----------
    Roessler, SIAM J. Numer. Anal. 48 (2010) 922, table 6.2. doi:10.1137/09076636X
    """

    def __init__(self, layer: Layer) -> None:
        self._layer = layer
        self._noise = math.sqrt(2.0 * layer.scene.D_r)
        shape = (len(layer.radius), layer.n_columns)
        self._first, self._second, self._stage = np.empty(shape), np.empty(shape), np.empty(shape)

    def restart(self) -> None:
        """Nothing is remembered from step to step."""

    def step(self, state: Floats, h: float, w: Floats, area: Floats) -> None:
        """Advance by two evaluations; the second one sees the time-averaged path."""
        self._layer.velocity(state, self._first)
        np.multiply(self._first, 0.75 * h, out=self._stage)
        self._stage += state
        self._stage[:, 2] += 1.5 * self._noise * (0.5 * w + area)
        self._layer.velocity(self._stage, self._second)
        self._second *= 2.0
        self._second += self._first
        self._second *= h / 3.0
        state += self._second
        state[:, 2] += self._noise * w


class Implicit:
    r"""Linearly implicit steps with one evaluation, on the mean of the Brownian path.

    With f the drift, A the stiff part of its Jacobian (see `stiffness`) and nu the noise of the
    polarities, whose mean over the step is nu-bar = (W / 2 + H) sqrt(2 D_r):

    .. math::
        \hat x = x + \bar\nu, \qquad (1 + c h A) d = h f(\hat x), \qquad x' = x + d + \nu

    c is 1/2 where a step is short for the contacts, which makes it the implicit midpoint rule, and
    grows with h times their mean stiffness: the push of a contact goes as the square root of its
    depth, so the secant over a step in which it opens is twice the tangent, and contacts that form
    within the step are not in A at all. Where A would change nothing it is left out.
    """

    def __init__(self, layer: Layer) -> None:
        _need_exact_contacts(layer)
        self._layer = layer
        self._noise = math.sqrt(2.0 * layer.scene.D_r)
        self._stiff = StiffPart(layer)
        shape = (len(layer.radius), layer.n_columns)
        self._middle, self._drift, self._moved = (np.empty(shape) for _ in range(3))
        self._h = 0.0
        self._diagonal = np.zeros_like(self._stiff.tension, dtype=np.float32)
        self._since = 0

    def restart(self) -> None:
        """Forget how stiff the contacts were: what follows depends on the state alone."""
        self._since = 0

    def step(self, state: Floats, h: float, w: Floats, area: Floats) -> None:
        """Advance by one evaluation and at most one linear solve."""
        stiff, middle, drift = self._stiff, self._middle, self._drift
        if h != self._h:
            # Exact for shape modes that relax alone: 1 / (1 + c z) = (1 - exp(-z)) / z.
            z = h * stiff.tension
            self._diagonal[:] = np.where(
                z > 1e-6, z / np.maximum(-np.expm1(-z), 1e-300) - 1.0, 0.5 * z
            )
            self._h = h
        np.copyto(middle, state)
        if self._noise > 0.0:
            middle[:, 2] += self._noise * (0.5 * w + area)
        self._layer.velocity(middle, drift)
        drift *= h
        if self._since % LOOK_EVERY == 0 or h * stiff.mean > SLACK:
            stiff.collect()
        self._since += 1
        if h * stiff.mean > SLACK or self._diagonal.max(initial=0.0) > SLACK:
            stiff.solve(middle, drift, h * _share(h * stiff.mean), self._diagonal, self._moved)
            state += self._moved
        else:
            state += drift
        if self._noise > 0.0:
            state[:, 2] += self._noise * w


class Rosenbrock:
    r"""Stochastic Rosenbrock-W steps of two evaluations: strong order 1.5, and an error estimate.

    With A and c as for `Implicit` (order 2 without noise holds for any A):

    .. math::
        (1 + c h A) k_1 = h f(x + \nu_1), \qquad
        (1 + c h A) k_2 = h f(x + k_1 + \nu_2) - 2 k_1, \qquad
        x' = x + \tfrac{3}{2} k_1 + \tfrac{1}{2} k_2 + \nu

    nu_1 and nu_2 are the noise at (1/2 -+ 1/sqrt 6) W + H: their mean is that of the path, and
    their mean square agrees with it in expectation. (k_1 + k_2) / 2, the difference to the step of
    order 1, estimates the error.

    Attributes
    ----------
    error
        RMS length of the estimated error of the centres in the last step, L0.

    References
    ----------
    Verwer, Spee, Blom & Hundsdorfer, SIAM J. Sci. Comput. 20 (1999) 1456 (ROS2, as a W-method);
    Roessler, SIAM J. Numer. Anal. 48 (2010) 922, theorem 5.? (order conditions for additive noise).
    """

    def __init__(self, layer: Layer) -> None:
        _need_exact_contacts(layer)
        self._layer = layer
        self._noise = math.sqrt(2.0 * layer.scene.D_r)
        self._stiff = StiffPart(layer)
        shape = (len(layer.radius), layer.n_columns)
        self._stage, self._drift, self._first, self._second = (np.empty(shape) for _ in range(4))
        self.error = 0.0

    def restart(self) -> None:
        """Nothing is remembered from step to step."""

    def step(self, state: Floats, h: float, w: Floats, area: Floats) -> None:
        """Advance by two evaluations and two linear solves with one matrix."""
        stiff, stage, drift = self._stiff, self._stage, self._drift
        first, second = self._first, self._second
        np.copyto(stage, state)
        if self._noise > 0.0:
            stage[:, 2] += self._noise * ((0.5 - EARLY) * w + area)
        self._layer.velocity(stage, drift)
        drift *= h
        stiff.collect()
        g = h * min(_share(h * stiff.mean), 2.0)
        z = h * stiff.tension
        diagonal = (z * np.minimum(0.5 * (1.0 + z), 1.0 + math.sqrt(0.5))).astype(np.float32)
        turned = stage[:, 2].copy()
        exact = min(1.0, h * stiff.mean) ** 2  # errors of the solves must not cost the order
        stiff.solve(stage, drift, g, diagonal, first, share=exact)
        np.add(state, first, out=stage)
        if self._noise > 0.0:
            stage[:, 2] += self._noise * ((0.5 + EARLY) * w + area)
        self._layer.velocity(stage, drift)
        drift *= h
        drift -= 2.0 * first
        stage[:, 2] = turned  # the frame in which the stiff part was collected
        stiff.solve(stage, drift, g, diagonal, second, share=exact)
        second += first
        second *= 0.5
        self.error = float(np.sqrt(np.mean(np.sum(second[:, :2] ** 2, axis=1))))
        state += first
        state += second
        if self._noise > 0.0:
            state[:, 2] += self._noise * w


SLACK = 0.3  # h times a stiffness below which a step needs no linear algebra
LOOK_EVERY = 32  # such steps after which the contacts are looked at again
EARLY = 1.0 / math.sqrt(6.0)  # of W, by which the two looks at the path differ from its middle
MOST_TRAVEL = 0.003  # of a cell by its own motion within a usual step, over its mean diameter
MOST_SHARE = 3.0  # larger ones only hold the layer back


def _share(z: float) -> float:
    """The factor c of the stiff part in a step of h times its mean stiffness z."""
    return min(MOST_SHARE, 0.5 * (1.0 + z))


def _need_exact_contacts(layer: Layer) -> None:
    if layer.contact != "exact" or layer.scene.rigid:
        raise InputError(
            "implicit integrators need deformable cells and the exact contact rule; "
            "choose integrator euler."
        )


@dataclass(frozen=True)
class Method:
    """An integrator as a user chooses it: how to make it, and its usual step in t0."""

    make: Callable[[Layer], Integrator]
    dt: float
    adaptive: bool = False

    def usual_step(self, scene: Scene) -> float:
        """The usual step, t0, shortened so that no cell propels itself by more than 0.003 L0."""
        travel = MOST_TRAVEL * 2.0 * scene.mean_radius
        return min(self.dt, travel / scene.v0) if scene.v0 > 0.0 else self.dt


METHODS: dict[str, Method] = {
    "euler": Method(Euler, 0.005),
    "sra1": Method(Sra1, 0.01),
    "implicit": Method(Implicit, 0.1),
    "rosenbrock": Method(Rosenbrock, 0.1),
    "adaptive": Method(Rosenbrock, 0.1, adaptive=True),
}


def recommended(scene: Scene, contact: str) -> str:
    """Name of the method with the least error for its time: `docs/accuracy_simulation.md`."""
    return "euler" if scene.rigid or contact != "exact" else "implicit"


def find_method(name: str) -> tuple[str, Method]:
    """Look a method up by name."""
    if name not in METHODS:
        raise InputError(
            f"integrator must be one of {', '.join(sorted(METHODS))}, got {name!r}; choose one."
        )
    return name, METHODS[name]

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
from cellquant.sim import stiffness
from cellquant.sim.contacts import Layer
from cellquant.sim.scene import Scene
from cellquant.sim.stiffness import square_roots_of_mobilities

Floats = NDArray[np.float64]


class Integrator(Protocol):
    """One method, bound to a layer."""

    def step(self, state: Floats, h: float, w: Floats, area: Floats) -> None:
        """Advance `state` by h, with increments w (N,) and areas (N,) of the Brownian paths."""


class Euler:
    """Euler-Maruyama, the published scheme: strong order 1, for h below 2 / stiffness."""

    def __init__(self, layer: Layer) -> None:
        self._layer = layer
        self._noise = math.sqrt(2.0 * layer.scene.D_r)
        self._slope = np.empty((len(layer.radius), layer.n_columns))

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
    r"""Linearly implicit steps with one correction: stable for stiff contacts at any step.

    With A = M H, M the mobilities and H the stiff part of the Hessian (see `stiffness`), f the
    drift and nu the noise of the step:

    .. math::
        (1 + h A) d_1 = h f(x) + \nu, \qquad
        (1 + h A) (d - d_1) = \tfrac{h}{2} [f(x + d_1) - (d_1 - \nu) / h]

    The contacts answer to the noise within the step, since nu stands on the right-hand side. The
    bracket is what the linearisation left out. Two evaluations; d - d_1 estimates the error.
    """

    def __init__(self, layer: Layer) -> None:
        scene = layer.scene
        if layer.contact != "exact" or scene.rigid:
            raise InputError(
                "the implicit integrator needs deformable cells and the exact contact rule; "
                "choose integrator euler."
            )
        self._layer = layer
        self._noise = math.sqrt(2.0 * scene.D_r)
        self._scale = square_roots_of_mobilities(
            scene.mu_r, scene.mu_theta, scene.mu_ab, scene.modes
        )
        inverse = np.zeros_like(self._scale)
        np.divide(1.0, self._scale, out=inverse, where=self._scale > 0.0)
        self._inverse = inverse
        shape = (len(layer.radius), layer.n_columns)
        self._modes = (0,) * (scene.modes - 1)
        self._padded = 8 * ((layer.n_columns + 7) // 8)
        n = np.arange(2, scene.modes + 1)
        stretch = np.concatenate([np.zeros(3), np.tile(n**2 - 1.0, 2)])
        self._diagonal = np.zeros((shape[0], self._padded))
        self._diagonal[:, : shape[1]] = (
            scene.eta * math.pi * layer.radius[:, None] * stretch * self._scale**2
        )
        self._drift, self._stage = np.empty(shape), np.empty(shape)
        self._right, self._first, self._second, *self._work = (
            np.zeros((shape[0], self._padded)) for _ in range(6)
        )
        self._allocate(8 * shape[0])
        self.error = 0.0

    def _allocate(self, room: int) -> None:
        self._weight = np.zeros((room, 2 * self._padded))
        self._factor = np.empty(room)
        self._turning = np.empty((room, 2))
        self._cells = np.empty((room, 2), np.int64)

    def _solve(self, h: float, out: Floats) -> None:
        stiffness.solve(
            self._count, self._weight, self._factor, self._cells, self._diagonal, h, self._modes,
            self._right, CG_TOLERANCE, CG_MOST, out, *self._work,
        )  # fmt: skip

    def step(self, state: Floats, h: float, w: Floats, area: Floats) -> None:
        """Advance by two evaluations and two linear solves."""
        width = state.shape[1]
        drift, stage, right = self._drift, self._stage, self._right[:, :width]
        first, second = self._first[:, :width], self._second[:, :width]
        self._layer.velocity(state, drift)
        while True:
            self._count = self._layer.gather_stiffness(
                state, self._scale, self._weight, self._factor, self._turning, self._cells
            )
            if self._count <= len(self._factor):
                break
            self._allocate(self._count + self._count // 4)
        turned = self._noise * w
        np.multiply(drift, h * self._inverse, out=right)
        if self._noise > 0.0:
            stiffness.add_turning(
                self._count, self._weight, self._factor, self._turning, self._cells, turned, h,
                self._right,
            )  # fmt: skip
        self._solve(h, self._first)
        np.multiply(first, self._scale, out=stage)
        stage += state
        stage[:, 2] += turned
        self._layer.velocity(stage, drift)
        np.multiply(drift, 0.5 * h * self._inverse, out=right)
        right -= 0.5 * first
        self._solve(h, self._second)
        np.multiply(second, self._scale, out=drift)
        self.error = float(np.sqrt(np.mean(np.sum(drift[:, :2] ** 2, axis=1))))
        np.add(stage, drift, out=state)


CG_TOLERANCE = 3e-2
CG_MOST = 200


@dataclass(frozen=True)
class Method:
    """An integrator as a user chooses it: how to make it, and its usual step in t0."""

    make: Callable[[Layer], Integrator]
    dt: float
    adaptive: bool = False


METHODS: dict[str, Method] = {
    "euler": Method(Euler, 0.005),
    "sra1": Method(Sra1, 0.01),
    "implicit": Method(Implicit, 0.1),
    "adaptive": Method(Implicit, 0.1, adaptive=True),
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

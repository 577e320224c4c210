"""From frame to frame: steps of one length, or steps that follow the error."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cellquant.sim.contacts import Layer
from cellquant.sim.integrators import Implicit, find_method
from cellquant.sim.noise import BrownianTree
from cellquant.sim.scene import SimulationFailure

Floats = NDArray[np.float64]

ROOT_DEPTH = 2  # a root of the Brownian tree spans 2^2 steps
WATCH_EVERY = 16  # steps between two checks of the step length
CHATTER_LIMIT = 0.02  # RMS change of the displacement from one step to the next, L0
DEEPEST = 14  # halvings of a frame interval that the adaptive method may make
EASY = 0.15  # share of the tolerance below which it doubles the step


@dataclass(frozen=True)
class Plan:
    """Steps of a run: n_before frames' worth of transient, then n_frames - 1 saved intervals."""

    h: float
    steps_per_frame: int
    n_before: int
    n_frames: int

    @classmethod
    def of(cls, duration: float, transient: float, save_every: float, dt: float) -> "Plan":
        """Divide the frame interval into equal steps no longer than dt."""
        steps = max(1, math.ceil(save_every / dt * (1.0 - 1e-12)))
        return cls(
            h=save_every / steps,
            steps_per_frame=steps,
            n_before=math.ceil(transient / save_every * (1.0 - 1e-12)),
            n_frames=1 + math.ceil(duration / save_every * (1.0 - 1e-12)),
        )


class FixedSteps:
    """Equal steps of one method, watched for steps that are too long.

    Attributes
    ----------
    count, rejected
        Steps taken and given up.
    elapsed
        Time since the start of the frame interval, t0.
    """

    def __init__(self, layer: Layer, integrator: str, plan: Plan) -> None:
        self.layer = layer
        self.plan = plan
        self.count = 0
        self.rejected = 0
        self.elapsed = 0.0
        self._method = find_method(integrator)[1].make(layer)
        self._tree = BrownianTree(layer.scene.seed, len(layer.radius), plan.h * 2**ROOT_DEPTH)
        self._still = np.zeros(len(layer.radius))
        self._chatter = 0.0

    def save(self) -> Floats:
        """What a checkpoint has to keep."""
        return np.array([self.count, self._chatter])

    def restore(self, stored: Floats) -> None:
        """Go on from what `save` returned."""
        self.count, self._chatter = int(stored[0]), float(stored[1])

    def advance(self, state: Floats, interval: int) -> None:
        """Advance a state over one frame interval, in place."""
        steps = self.plan.steps_per_frame
        leaves = 2**ROOT_DEPTH
        before = state[:, :2].copy()
        moved: Floats | None = None
        for index in range(interval * steps, (interval + 1) * steps):
            w = area = self._still
            if self.layer.scene.has_noise:
                ws, areas = self._tree.level(index // leaves, ROOT_DEPTH)
                w, area = ws[index % leaves], areas[index % leaves]
            watched = index % WATCH_EVERY < 2
            if watched:
                before[:] = state[:, :2]
            self._method.step(state, self.plan.h, w, area)
            self.count += 1
            self.elapsed = (index + 1 - interval * steps) * self.plan.h
            if watched:
                previous, moved = moved, state[:, :2] - before
                self._watch(moved, previous if index % WATCH_EVERY == 1 else None)
        self.elapsed = 0.0

    def _watch(self, moved: Floats, previous: Floats | None) -> None:
        """Stop where cells jump, or where the displacement changes too much from step to step."""
        remedy = "take a smaller dt or the adaptive integrator"
        reach = float(np.abs(moved).max())
        if not reach < 0.5 * self.layer.scene.mean_radius:
            cell = int(np.argmax(np.abs(moved).max(axis=1)))
            raise SimulationFailure("a cell jumped within one step", remedy, cell=cell)
        if previous is None:
            return
        change = float(np.sqrt(np.mean((moved - previous) ** 2)))
        self._chatter += 0.2 * (change / (2.0 * self.layer.scene.mean_radius) - self._chatter)
        if self._chatter > CHATTER_LIMIT:
            raise SimulationFailure("the step is too long for the contacts, which chatter", remedy)


class AdaptiveSteps:
    """Steps of the implicit method, halved and doubled so that each stays within a tolerance.

    Steps are dyadic parts of the frame interval, so that a rejected step is repeated in halves on
    the same Brownian path, and two easy ones are followed by one of twice the length.

    Attributes
    ----------
    count, rejected
        Steps taken and given up.
    elapsed
        Time since the start of the frame interval, t0.
    """

    def __init__(self, layer: Layer, plan: Plan, tolerance: float) -> None:
        self.layer = layer
        self.count = 0
        self.rejected = 0
        self.elapsed = 0.0
        self._tolerance = tolerance
        self._span = plan.h * plan.steps_per_frame
        self._method = Implicit(layer)
        self._tree = BrownianTree(layer.scene.seed, len(layer.radius), self._span)
        self._still = np.zeros(len(layer.radius))
        first = find_method("implicit")[1].dt
        self._depth = max(0, math.ceil(math.log2(self._span / first)))

    def save(self) -> Floats:
        """What a checkpoint has to keep."""
        return np.array([self.count, self.rejected, self._depth], np.float64)

    def restore(self, stored: Floats) -> None:
        """Go on from what `save` returned."""
        self.count, self.rejected, self._depth = (int(x) for x in stored)

    def advance(self, state: Floats, interval: int) -> None:
        """Advance a state over one frame interval, in place."""
        before = np.empty_like(state)
        index = 0
        while index < 2**self._depth:
            h = self._span / 2**self._depth
            w = area = self._still
            if self.layer.scene.has_noise:
                ws, areas = self._tree.level(interval, self._depth)
                w, area = ws[index], areas[index]
            before[:] = state
            failure: SimulationFailure | None = None
            try:
                self._method.step(state, h, w, area)
            except SimulationFailure as caught:
                failure = caught
            error = self._method.error
            if failure is None and error <= self._tolerance:
                self.count += 1
                index += 1
                self.elapsed = index * h
                if error < EASY * self._tolerance and self._depth > 0 and index % 2 == 0:
                    self._depth -= 1
                    index //= 2
                continue
            state[:] = before
            self.rejected += 1
            if self._depth == self._deepest():
                reason = "steps keep failing" if failure is None else failure.reason
                raise SimulationFailure(
                    f"{reason} even at a step of {h:.2g} t0",
                    "raise the tolerance, or make the scene less extreme (phi, v0, eta)",
                    cell=None if failure is None else failure.cell,
                )
            self._depth += 1
            index *= 2
        self.elapsed = 0.0

    def _deepest(self) -> int:
        """Deepest level: DEEPEST halvings of an interval of one t0."""
        return max(4, DEEPEST + math.ceil(math.log2(self._span)))

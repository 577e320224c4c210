"""Initial states: radii, box, lattice or random centres."""

import math

import numpy as np
from numpy.typing import NDArray

from cellquant.sim.contacts import Layer
from cellquant.sim.scene import Scene

Floats = NDArray[np.float64]
SMALLEST = 0.1  # smallest drawn radius over the mean


def draw_radii(scene: Scene) -> Floats:
    """Radii R0_i = Rbar (1 + delta_i), delta normal; those below a tenth of Rbar drawn again."""
    if scene.radii is not None:
        return np.array(scene.radii, np.float64)
    rng = np.random.default_rng([scene.seed, 1])
    scaled = 1.0 + scene.polydispersity * rng.standard_normal(scene.n_cells)
    while (low := scaled < SMALLEST).any():
        scaled[low] = 1.0 + scene.polydispersity * rng.standard_normal(int(low.sum()))
    return scene.mean_radius * scaled


def lattice_rows(n_cells: int, aspect: float | None) -> int:
    """Even number of rows of a hexagonal lattice that comes closest to regular triangles."""
    if n_cells == 1:
        return 1
    ratio = 1.0 if aspect is None else aspect
    rows = math.sqrt(n_cells * 2.0 / (math.sqrt(3.0) * ratio))
    return max(2, 2 * round(rows / 2.0)) if n_cells > 3 else min(2, n_cells)


def box_edges(scene: Scene, radius: Floats) -> Floats:
    """Edges (Lx, Ly) of the box: as given, or from the packing fraction."""
    if scene.box is not None:
        return np.array(scene.box, np.float64)
    area = float(np.sum(math.pi * radius**2)) / scene.phi
    if scene.aspect is not None:
        aspect = scene.aspect
    else:
        rows = lattice_rows(scene.n_cells, None)
        columns = -(-scene.n_cells // rows)
        aspect = 1.0 if scene.n_cells < 4 else columns / (rows * math.sqrt(0.75))
    return np.array([math.sqrt(area * aspect), math.sqrt(area / aspect)])


def initial_state(scene: Scene) -> tuple[Floats, Floats, Floats]:
    """Return state (N, 3 + 2(M-1)), radii (N,) and box (2,) of a scene at time zero."""
    radius = draw_radii(scene)
    box = box_edges(scene, radius)
    state = np.zeros((scene.n_cells, 3 + 2 * (scene.modes - 1)))
    rng = np.random.default_rng([scene.seed, 2])
    angles = rng.uniform(0.0, 2.0 * math.pi, scene.n_cells)
    state[:, 2] = angles if scene.polarities is None else scene.polarities
    if scene.shapes is not None:
        state[:, 3:] = scene.shapes
    if scene.positions is not None:
        state[:, :2] = scene.positions
    elif scene.initial == "random":
        state[:, :2] = rng.uniform(0.0, 1.0, (scene.n_cells, 2)) * box
        _relax(scene, state, radius, box)
    else:
        rows = lattice_rows(scene.n_cells, scene.aspect)
        columns = -(-scene.n_cells // rows)
        # Where the last places stay empty, they are spread over the lattice.
        chosen = (np.arange(scene.n_cells) * (rows * columns)) // scene.n_cells
        row, column = np.divmod(chosen, columns)
        state[:, 0] = (column + 0.5 * (row % 2) + 0.25) * box[0] / columns
        state[:, 1] = (row + 0.5) * box[1] / rows
    return state, radius, box


def _relax(scene: Scene, state: Floats, radius: Floats, box: Floats) -> None:
    """Push randomly placed cells apart as passive rigid discs, by at most 1 % of Rbar a step."""
    discs = scene.replace(v0=0.0, D_r=0.0, modes=1, eta=0.0, k=1.0, mu_r=1.0)
    layer = Layer(discs, radius, box)
    discs_state = np.ascontiguousarray(state[:, :3])
    push = np.empty_like(discs_state)
    for _ in range(400):
        layer.velocity(discs_state, push)
        largest = float(np.abs(push).max())
        if largest < 1e-3:
            break
        discs_state[:, :2] += push[:, :2] * min(0.05, 0.05 * scene.mean_radius / largest)
    state[:, :2] = discs_state[:, :2]

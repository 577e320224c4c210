"""The simulator of the deformable-cell layer; its names are loaded on first use."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

_HOMES = {
    "Scene": "scene",
    "SimulationFailure": "scene",
    "Run": "archive",
    "open_run": "run",
    "simulate": "run",
    "render": "rendering",
    "convergence": "workprecision",
}

__all__ = sorted(_HOMES)

if TYPE_CHECKING:
    from cellquant.sim.archive import Run as Run
    from cellquant.sim.run import open_run as open_run
    from cellquant.sim.run import simulate as simulate
    from cellquant.sim.scene import Scene as Scene
    from cellquant.sim.scene import SimulationFailure as SimulationFailure


def __getattr__(name: str) -> Any:
    home = _HOMES.get(name)
    if home is None:
        raise AttributeError(f"module 'cellquant.sim' has no attribute {name!r}")
    value = getattr(import_module(f"cellquant.sim.{home}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__

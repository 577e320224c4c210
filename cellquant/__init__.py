"""cellquant: trajectories, glassy dynamics and simulations of dense cell layers.

The public names are loaded on first use, so that importing the package (and
``cellquant --help``) costs nothing of NumPy, Numba or pandas.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

_HOMES = {
    "InputError": "cellquant.errors",
    "Tracks": "cellquant.tables",
    "read_tracks": "cellquant.tables",
    "read_labels": "cellquant.io",
    "read_images": "cellquant.io",
    "LabelStack": "cellquant.io",
    "measure_cells": "cellquant.segment",
    "track": "cellquant.track",
    "observe": "cellquant.observables",
    "Scene": "cellquant.sim",
    "simulate": "cellquant.sim",
    "open_run": "cellquant.sim",
    "render": "cellquant.sim",
    "compare": "cellquant.compare",
}

__all__ = ["__version__", *sorted(_HOMES)]

if TYPE_CHECKING:
    from cellquant.errors import InputError as InputError
    from cellquant.tables import Tracks as Tracks
    from cellquant.tables import read_tracks as read_tracks


def __getattr__(name: str) -> Any:
    home = _HOMES.get(name)
    if home is None:
        raise AttributeError(f"module 'cellquant' has no attribute {name!r}")
    # Where a sub-package bears the name of its main function (track, compare), importing it binds
    # the module here; those modules are callable and pass the call on to the function.
    return getattr(import_module(home), name)


def __dir__() -> list[str]:
    return __all__

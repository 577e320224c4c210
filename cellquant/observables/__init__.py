"""Observables of trajectories and of cell shapes, each with its standard error."""

from cellquant.observables.observe import (
    Observables,
    available_observables,
    columns_read,
    needs_tracks,
    observe,
)

__all__ = [
    "Observables",
    "available_observables",
    "columns_read",
    "needs_tracks",
    "observe",
]

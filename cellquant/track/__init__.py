"""Cells to tracks. The module itself is callable: ``cellquant.track(masks)``."""

import sys
from types import ModuleType
from typing import Any

from cellquant.tables import Tracks
from cellquant.track.link import track, track_cells

__all__ = ["track", "track_cells"]


class _CallableModule(ModuleType):
    """The package module; a call is passed on to `track`."""

    def __call__(self, *arguments: Any, **options: Any) -> Tracks:
        return track(*arguments, **options)


sys.modules[__name__].__class__ = _CallableModule

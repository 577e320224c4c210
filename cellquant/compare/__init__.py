"""Experiment and simulation side by side. The module is callable: ``cellquant.compare(a, b)``."""

import sys
from types import ModuleType
from typing import Any

from cellquant.compare.comparison import Comparison, compare

__all__ = ["Comparison", "compare"]


class _CallableModule(ModuleType):
    """The package module; a call is passed on to `compare`."""

    def __call__(self, *arguments: Any, **options: Any) -> Comparison:
        return compare(*arguments, **options)


sys.modules[__name__].__class__ = _CallableModule

"""How sure a link or a division is, among all that could have been chosen in its stead."""

from dataclasses import dataclass, replace

import numpy as np

from cellquant.track.belief import option_marginals
from cellquant.track.movie import FloatArray, IntArray, Links

_SWEEPS = 8
# Log odds add up evidence as if each piece were independent, and rest on links that may be wrong.
# By how much they say too much was learned on layers whose truth is known, real and synthetic, and
# checked on others (docs/accuracy_tracking.md); the doubt comes from the movie.
_FAMILY_HEAT = 4.0  # divisions: many pieces that tell the same
_LINK_DOUBT, _LINK_HEAT = 0.002, 0.8  # links: from this mean doubt on, per e-fold of it


@dataclass(frozen=True)
class Choice:
    """What the last assignment chose from.

    ``cells`` (O, 3) source and target, or mother and two daughters, of links and then of
    divisions; -1 where an option has fewer. ``gain`` (O,) log odds; ``links`` and ``divisions``
    are the indices of those chosen.
    """

    cells: IntArray
    gain: FloatArray
    links: IntArray
    divisions: IntArray


def calibrated(links: Links, choice: Choice) -> Links:
    """Links with the confidence that each is true, whatever else competes for its cells.

    All options of all frames are judged together by belief propagation, with log odds divided by
    a heat. That of links is ``1 + 0.8 ln(doubt / 0.002)`` and at least 1, where ``doubt`` is the
    mean chance of the chosen links to be wrong as it was before: the more links are wrong, the
    more evidence rests on wrong links. That of divisions is 4.
    """
    confidence = links.confidence.copy()
    target = choice.cells[choice.links, 1]
    if len(target):
        doubt = float(np.mean(1.0 - confidence[target]))
        heat = 1.0 + _LINK_HEAT * float(np.log(max(doubt / _LINK_DOUBT, 1.0)))
        confidence[target] = _chances(choice, heat)[choice.links]
    if len(choice.divisions):
        sure = _chances(choice, _FAMILY_HEAT)[choice.divisions]
        for daughter in (1, 2):
            confidence[choice.cells[choice.divisions, daughter]] = sure
    return replace(links, confidence=confidence)


def _chances(choice: Choice, heat: float) -> FloatArray:
    # Sources and targets are cells in two roles, which never meet.
    cells = choice.cells.copy()
    cells[:, 1:] += np.where(cells[:, 1:] >= 0, cells.max(initial=0) + 1, 0)
    chance = np.empty(len(cells))
    option_marginals(cells, choice.gain / heat, _SWEEPS, chance)
    return chance

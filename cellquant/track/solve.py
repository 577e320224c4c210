"""Passes over the movie: gains from the present model, best links, a better model."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from cellquant.track.assign import match_with_divisions
from cellquant.track.belief import marginals
from cellquant.track.confidence import Choice, calibrated
from cellquant.track.costs import (
    Motion,
    Paths,
    expected_steps,
    first_motion,
    fit_motion,
    gains,
    paths,
)
from cellquant.track.cues import Cue, Look, evidence, fit_cue, joined
from cellquant.track.divisions import (
    Divisions,
    Families,
    are_broken,
    broken_masks,
    fit_divisions,
    no_families,
    propose,
    size_frequencies,
    weigh,
)
from cellquant.track.fates import Fates, Rates, fates, fit_rates, places, suppose_divisions
from cellquant.track.flow import CANDIDATES, all_flows
from cellquant.track.images import PairImages
from cellquant.track.movie import BoolArray, FloatArray, IntArray, Links, Movie
from cellquant.track.near import nearest_cells
from cellquant.track.shapes import Shapes, fit_shapes, population_of

if TYPE_CHECKING:
    from cellquant.io import ImageStack, LabelStack

PASSES, MOST_PASSES = 5, 9
# Share of links that a pass changes: below the second there are more passes, until the first.
_STILL, _NEARLY_STILL = 0.003, 0.1
_UNLIKELY = 1e-4  # links below this probability are not offered to the assignment
_MARGIN = 3.0  # of log odds below that, where links no longer matter to their rivals
_SWEEPS = 6  # of belief propagation
_SURE = 0.999  # a cell whose mother is known with this probability needs no division
_DIVISION_PASS = 1  # the first pass that looks for divisions
_WIDE, _EARLY = 0.75, 2  # a start wider than this, in spacings, takes more passes to settle
_FEW = 0.2  # divisions per newcomer below which the first look is repeated
_IMAGE_PASS = 2  # the first pass that looks at the images
_SETTLED = 0.999  # cells whose partner is known with this probability need no image
_CALIBRATION_CELLS = 2000  # compared in any case, to learn what images tell


@dataclass(frozen=True)
class Options:
    """What the user decides, and the cues that can be left out to see what they bring."""

    divisions: bool = True
    max_distance: float = np.inf
    use_neighbours: bool = True
    use_path: bool = True
    use_shape: bool = True
    use_images: bool = True


@dataclass
class Solution:
    """Links with the model that they were judged by; refined from pass to pass."""

    movie: Movie
    flow: FloatArray
    carried: FloatArray
    candidates: IntArray
    leaving: IntArray
    entering: IntArray
    known: Paths
    motion: Motion
    shapes: Shapes
    rates: Rates
    sizes: FloatArray
    links: Links | None = None
    families: Families = field(default_factory=no_families)
    broken: BoolArray = field(default_factory=lambda: np.empty(0, dtype=np.bool_))
    divisions: Divisions | None = None
    probability: FloatArray | None = None
    looked: IntArray | None = None
    looks: list[Look] | None = None
    cues: list[Cue | None] = field(default_factory=list)
    family_cues: list[Cue | None] = field(default_factory=list)
    gain: FloatArray | None = None
    choice: Choice | None = None
    fates: Fates | None = None


def solve(
    movie: Movie,
    options: Options,
    *,
    masks: "LabelStack | None" = None,
    raw: "ImageStack | None" = None,
    pixel_size: float = 1.0,
    progress: Callable[[int, int], None] | None = None,
) -> Solution:
    """Link the cells of successive frames.

    Parameters
    ----------
    movie
        At least two frames with cells.
    options
        Limits and cues.
    masks
        The masks that were measured; None leaves out image correlation.
    raw
        The recorded movie, or None.
    pixel_size
        Edge of a pixel in the unit of the positions.
    progress
        Called with the number of frames done and of all frames, as it were: every pass goes over
        all of them.
    """
    state = _start(movie, options)
    wide = state.motion.scale[0] > _WIDE * float(np.median(movie.spacing))
    turn = first = -_EARLY if wide else 0
    frames, total = len(movie.time), MOST_PASSES - first + 1
    images = None
    changed = 1.0
    if progress is not None:
        progress(frames // total, frames)
    while turn < PASSES or (turn < MOST_PASSES and _STILL < changed < _NEARLY_STILL):
        if state.links is not None:
            _refit(state, options, turn)
        state.fates = fates(movie, state.links, state.rates, state.leaving, state.entering)
        before, links = state.gain, state.links
        state.gain = gains(
            movie,
            state.candidates,
            state.known,
            state.motion,
            state.shapes,
            state.fates,
            options.max_distance,
        )
        if masks is not None and options.use_images and turn >= _IMAGE_PASS:
            if images is None:
                images = PairImages(movie, masks, raw, pixel_size)
            # Looked at twice: a later pass expects the cells more exactly.
            if state.looks is None or turn == PASSES - 1:
                ahead = expected_steps(movie, state.known, state.motion, own_path=True)
                images.expect(movie.position + ahead)
                state.looked, state.looks = _compare(state, images)
            _add_images(state)
        if turn > _IMAGE_PASS and changed < _NEARLY_STILL:
            # Links in doubt pull the model to and fro; the mean of the passes is better than any.
            assert before is not None
            state.gain = np.where(
                np.isfinite(before) & np.isfinite(state.gain),
                (before + state.gain) / 2,
                state.gain,
            )
        middle = movie.position + expected_steps(movie, state.known, state.motion, own_path=False)
        if options.divisions and turn >= _DIVISION_PASS:
            state.divisions = fit_divisions(
                movie,
                state.families[state.families.chosen],
                state.broken[state.families.chosen],
                middle,
                state.sizes,
                spread=state.motion.spread * np.sqrt(movie.elapsed),
                width=float(state.motion.scale[0]),
                tail=float(state.motion.tail[0]),
            )
        state.links = _assign(state, middle, images)
        if links is not None:
            changed = float(np.mean(links.after != state.links.after))
        turn += 1
        if progress is not None:
            progress(frames * (turn - first + 1) // total, frames)
    if state.links is not None and state.choice is not None:
        state.links = calibrated(state.links, state.choice)
    if state.links is not None and state.divisions is not None and len(state.divisions.width) > 2:
        state.links = _mended(movie, state.links)
    if progress is not None:
        progress(frames, frames)
    return state


def _mended(movie: Movie, links: Links) -> Links:
    """Links where a mother whose mask only fell apart goes on in the part that is left."""
    mother = np.flatnonzero(links.second >= 0)
    one, two = links.after[mother], links.second[mother]
    left = broken_masks(movie, links, np.column_stack((mother, one, two)))
    found = left >= 0
    mother, left, lost = mother[found], left[found], np.where(left == one, two, one)[found]
    after, second, before = links.after.copy(), links.second.copy(), links.before.copy()
    after[mother], second[mother], before[lost] = left, -1, -1
    return replace(links, after=after, second=second, before=before)


def _start(movie: Movie, options: Options) -> Solution:
    flow, carried = all_flows(movie, local=options.use_neighbours)
    candidates = np.full((movie.n_cells, CANDIDATES), -1, dtype=np.int64)
    for index in range(len(movie.time) - 1):
        a, b = movie.cells_of(index), movie.cells_of(index + 1)
        found, _ = nearest_cells(movie.position[a] + flow[a], movie.position[b], CANDIDATES)
        candidates[a] = np.where(found >= 0, found + movie.start[index + 1], -1)
    leaving, entering = places(movie, flow)
    nobody = np.zeros(movie.n_cells)
    return Solution(
        movie=movie,
        flow=flow,
        candidates=candidates,
        leaving=leaving,
        entering=entering,
        carried=carried,
        known=_paths(movie, None, flow, carried, options),
        motion=first_motion(movie, flow, candidates),
        shapes=fit_shapes(movie, None, population_of(movie)),
        rates=fit_rates(movie, None, nobody, nobody, leaving, entering),
        sizes=size_frequencies(movie),
    )


def _paths(
    movie: Movie,
    links: Links | None,
    flow: FloatArray,
    carried: FloatArray,
    options: Options,
) -> Paths:
    known = paths(movie, links, flow, carried)
    if not options.use_path:
        nobody = np.zeros_like(known.has_after)
        known = replace(known, has_after=nobody, has_before=nobody)
    if not options.use_neighbours:
        nothing = np.zeros_like(known.around_after)
        known = replace(known, around_after=nothing, around_before=nothing)
    return known


def _refit(state: Solution, options: Options, turn: int) -> None:
    movie, links = state.movie, state.links
    assert links is not None
    state.known = _paths(movie, links, state.flow, state.carried, options)
    assert state.probability is not None
    state.motion = fit_motion(
        movie, links, state.candidates, state.probability, state.known, state.motion
    )
    if options.use_shape:
        state.shapes = fit_shapes(movie, links, state.shapes.population)
    families = state.families
    state.broken = are_broken(movie, links, families)
    divided, born = np.zeros(movie.n_cells), np.zeros(movie.n_cells)
    np.add.at(divided, families.cells[~state.broken, 0], families.weight[~state.broken])
    np.add.at(born, families.cells[:, 1:], families.weight[:, None])
    state.rates = fit_rates(
        movie,
        links,
        np.minimum(divided, 1.0),
        np.minimum(born, 1.0),
        state.leaving,
        state.entering,
    )
    if options.divisions and turn >= _DIVISION_PASS:
        # A first look may come before steps are known well enough to leave a daughter over.
        newcomers = int(np.sum(links.before[movie.start[1] :] < 0))
        found = int(np.sum(links.second >= 0))
        if turn == _DIVISION_PASS or (turn == _DIVISION_PASS + 1 and found < _FEW * newcomers):
            state.rates = suppose_divisions(state.rates)


def _add_images(state: Solution) -> None:
    """Add image correlation to the gains, calibrated on the present links."""
    links, gain, source = state.links, state.gain, state.looked
    assert links is not None
    assert gain is not None
    if not state.looks or source is None:
        return
    target = state.candidates[source]
    linked = (links.after[source, None] == target) & (links.second[source, None] < 0)
    stranger = links.before[target] != source[:, None]
    state.cues = [fit_cue(look, linked.reshape(-1), stranger.reshape(-1)) for look in state.looks]
    gain[source] += evidence(state.cues, state.looks).reshape(target.shape)


def _compare(state: Solution, images: PairImages) -> tuple[IntArray, list[Look]]:
    """Compare doubtful cells with their candidates, and a sample of the others to calibrate."""
    movie, candidates = state.movie, state.candidates
    assert state.probability is not None
    best = state.probability.max(axis=1)
    wanted = (best > _UNLIKELY) & (best < _SETTLED)
    wanted[:: max(1, movie.n_cells // _CALIBRATION_CELLS)] = True
    wanted[movie.start[-2] :] = False
    rows = np.flatnonzero(wanted & ~movie.cut)
    targets = np.where(movie.cut[candidates[rows]], -1, candidates[rows])
    frame = movie.frame_index[rows]
    looks = [
        images.pairs(index, rows[frame == index], targets[frame == index])
        for index in np.unique(frame).tolist()
    ]
    return rows, [joined(list(kind)) for kind in zip(*looks, strict=True)]


def _families(
    state: Solution, orphan: BoolArray, middle: FloatArray, images: PairImages | None
) -> tuple[IntArray, FloatArray, BoolArray, list[Look]]:
    """Divisions worth considering, their log odds, which are seen whole, and how the images of
    those look."""
    assert state.divisions is not None
    assert state.fates is not None
    assert state.gain is not None
    # A daughter is no farther from its mother than a step may be long.
    candidates = np.where(np.isneginf(state.gain), -1, state.candidates)
    cells, gain = propose(
        state.movie,
        candidates,
        orphan,
        middle,
        state.divisions,
        state.motion.spread * np.sqrt(state.movie.elapsed),
        float(state.motion.tail[0]),
        state.fates.divide,
        state.fates.vanish,
        state.fates.appear_sized,
    )
    # What the edge cuts off is not known of masks either.
    whole: BoolArray = np.asarray(~state.movie.cut[cells].any(axis=1))
    if images is None or not whole.any():
        return cells, gain, whole, []
    looks = images.families(cells[whole])
    gain[whole] += evidence(state.family_cues, looks)
    return cells, gain, whole, looks


def _assign(state: Solution, middle: FloatArray, images: PairImages | None) -> Links:
    movie, candidates, gain = state.movie, state.candidates, state.gain
    assert gain is not None
    n = movie.n_cells
    probability = state.probability = np.empty(candidates.shape)
    marginals(
        gain,
        candidates,
        movie.start,
        _SWEEPS,
        float(np.log(_UNLIKELY)) - _MARGIN,
        -float(np.log(_UNLIKELY)),
        probability,
    )
    row, slot = np.nonzero(probability > _UNLIKELY)
    column, sure = candidates[row, slot], probability[row, slot]
    families, odds = np.empty((0, 3), dtype=np.int64), np.empty(0)
    whole = np.empty(0, dtype=np.bool_)
    looks: list[Look] = []
    if state.divisions is not None:
        reached = np.zeros(n)
        np.maximum.at(reached, column, sure)
        families, odds, whole, looks = _families(state, reached < _SURE, middle, images)
    chosen, split = match_with_divisions(row, column, gain[row, slot], families, odds)
    alone = np.full(len(row), -1)
    state.choice = Choice(
        cells=np.concatenate((np.column_stack((row, column, alone)), families)),
        gain=np.concatenate((gain[row, slot], odds)),
        links=chosen,
        divisions=len(row) + split,
    )
    row, slot, column, sure = row[chosen], slot[chosen], column[chosen], sure[chosen]
    state.families = weigh(families, odds, split, row, column, gain[row, slot], candidates, gain)
    if looks:
        taken = np.zeros(len(odds), dtype=bool)
        taken[split] = True
        taken = taken[whole]
        state.family_cues = [fit_cue(look, taken, ~taken) for look in looks]
    after = np.full(n, -1, dtype=np.int64)
    second, before = after.copy(), after.copy()
    confidence = np.zeros(n)
    after[row], before[column], confidence[column] = column, row, sure
    mother, one, two = families[split].T
    after[mother], second[mother] = one, two
    before[one] = before[two] = mother
    confidence[one] = confidence[two] = 1.0 / (1.0 + np.exp(-np.minimum(odds[split], 50.0)))
    return Links(after, second, before, confidence)

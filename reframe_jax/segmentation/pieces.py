"""Pieces: parts of a recording in which one model holds, fitted again and joined across pauses."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from reframe_jax.segmentation.bank import Bank, best_scores, choose_models, fit_models
from reframe_jax.segmentation.cells import Cells
from reframe_jax.segmentation.rows import Fits, fit_spans
from reframe_jax.segmentation.sequence import cover, likeliest
from reframe_jax.tuning import SEGMENTS as C

_SHORTEST, _LONGEST = 8, 512  # cells in a window
_ROUNDS = 6  # most rounds of fits to the pieces of the best sequence


class Piece(NamedTuple):
    """A part of a recording: the cells [start, stop), and their model.

    The model is a bank of one model, or None if no coordinate is held (free motion).
    """

    start: int
    stop: int
    model: Bank | None

    @property
    def held(self) -> tuple[int, int]:
        """Numbers of held translations and held rotations."""
        return (0, 0) if self.model is None else (int(self.model.held[0, 0]), int(self.model.held[0, 1]))

    @property
    def still(self) -> bool:
        """Whether the body is still."""
        return self.held == (3, 3)


def find_pieces(cells: Cells) -> list[Piece]:
    """Divide a recording into the most probable sequence of models.

    The models are fitted to windows of many lengths, then to the pieces of the best sequence.
    A model may not explain a piece in which no fit to this piece alone pays its price.
    """
    number = cells.linear.shape[1]
    first = fit_models(cells, _windows(number))
    if not len(first.score):
        return [Piece(0, number, None)]
    known = cover(cells, first)
    bank, coverage = first, known
    tried, done = first.take([]), set[tuple[int, int]]()
    for _ in range(_ROUNDS):
        path = likeliest(coverage, cells.price)
        edges = [0, *(np.flatnonzero(np.diff(path)) + 1).tolist(), number]
        # pieces, pieces without their ends, and two and three consecutive pieces
        spans = {span for count in (1, 2, 3) for span in zip(edges, edges[count:], strict=False)}
        spans |= {(a + cut, b - cut) for a, b in pairwise(edges) for cut in (1, 2)}
        spans = {span for span in spans if span[1] - span[0] >= 3}
        new = np.array(sorted(spans - done)).reshape(-1, 2)
        if len(new):
            tried = tried.join(fit_models(cells, new))
            done |= spans
        again = tried.take([k for k, span in enumerate(tried.span.tolist()) if tuple(span) in spans])
        # a model of a longer span has too much evidence in a short piece, which moves little anyway
        best, pieces = best_scores(again), []
        for a, b in pairwise(edges):
            piece = Piece(a, b, bank.take([path[a]]) if path[a] >= 0 else None)
            paid = piece.still or best.get((a, b), -np.inf) >= 0
            pieces.append(piece if paid else Piece(a, b, None))
        fresh = again.join(*(piece.model for piece in pieces if piece.model is not None))
        if not len(new) or not len(fresh.score):
            break
        bank = first.join(fresh)
        coverage = known.join(cover(cells, fresh))
    return _join_free(pieces)


def _join_free(pieces: list[Piece]) -> list[Piece]:
    """Join consecutive pieces of free motion."""
    joined = pieces[:1]
    for piece in pieces[1:]:
        if piece.model is None and joined[-1].model is None:
            joined[-1] = joined[-1]._replace(stop=piece.stop)
        else:
            joined.append(piece)
    return joined


def _windows(number: int) -> np.ndarray:
    """Spans of 8, 16, 32, ... cells, at steps of four cells or a quarter of their length, and the whole."""
    length, spans = _SHORTEST, [np.array([[0, number]])]
    while length < min(number, _LONGEST + 1):
        start = np.arange(0, number - length + 1, max(_SHORTEST, length // 2) // 2)
        spans.append(np.stack([start, start + length], axis=1))
        length *= 2
    return np.concatenate(spans)


def join_pieces(cells: Cells, pieces: list[Piece]) -> list[Piece]:
    """Join consecutive pieces of one constraint, also across a pause.

    A long pause between different constraints, or at an end of the recording, remains a piece.
    """
    tried: dict[tuple[float, ...], Piece | None] = {}
    while True:
        order = sorted(range(len(pieces)), key=lambda i: pieces[i].stop - pieces[i].start)
        joined = next((new for i in order if (new := _join_one(cells, pieces, i, tried)) is not None), None)
        if joined is None:
            return pieces
        pieces = joined


def _join_one(
    cells: Cells, pieces: list[Piece], i: int, tried: dict[tuple[float, ...], Piece | None]
) -> list[Piece] | None:
    """Join piece i with its neighbours; None if the piece stays separate."""
    own = pieces[i]
    beside = [j for j in (i - 1, i + 1) if 0 <= j < len(pieces)]
    time = (own.stop - own.start) * cells.weight
    for j in beside:
        one = pieces[j]
        if one.model is None:
            continue
        trials = []
        if own.model is None:
            if time < 1:
                trials.append((min(i, *beside), max(i, *beside), [one.model]))
            trials.append((min(i, j), max(i, j), [one.model]))
        else:
            if own.still and one.still:
                longer = max(own, one, key=lambda piece: piece.stop - piece.start)
                joined = longer._replace(start=min(own.start, one.start), stop=max(own.stop, one.stop))
                return [*pieces[: min(i, j)], joined, *pieces[max(i, j) + 1 :]]
            if own.held == one.held:
                trials.append((min(i, j), max(i, j), [own.model, one.model]))
            state = time >= 1 if len(beside) == 1 else pieces[2 * i - j].still
            if own.still and not state:
                trials.append((min(i, *beside), max(i, *beside), [one.model]))
        for first, last, models in trials:
            span = pieces[first].start, pieces[last].stop
            key = (*span, *(float(value) for model in models for value in (*model.held[0], model.score[0])))
            if key not in tried:
                tried[key] = _together(cells, *span, models)
            new = tried[key]
            if new is not None:
                return [*pieces[:first], new, *pieces[last + 1 :]]
    return None


def _together(cells: Cells, start: int, stop: int, models: list[Bank]) -> Piece | None:
    """Make one piece of a span if the rows of models with equal ``held`` stay held in the whole span."""
    span = np.array([[start, stop]])
    fits = fit_spans(cells, span)
    found = choose_models(cells, span, fits)
    translations, rotations = models[0].held[0]
    size = np.stack([model.size[0] for model in models])
    for count, own, fitted, floor in (
        (translations, size[:, :3], fits.size[0, translations - 1], cells.floor[0]),
        (rotations, size[:, 3:], fits.turn[0], cells.floor[1]),
    ):
        # slow errors of a tracker affect different rows in different spans: the largest row decides
        if count and fitted[:, :count].max(axis=1).min() > max(C.alike * own[:, :count].max(), 2 * floor):
            return None
    same = np.flatnonzero(np.all(found.held == models[0].held, axis=1))
    return Piece(start, stop, found.take(same[:1]) if len(same) else models[0])


def label_pieces(cells: Cells, pieces: list[Piece]) -> list[int]:
    """Number the constraints of pieces in order of appearance; a still body has the label -1.

    Two pieces have the same constraint if they hold equal numbers of translations and rotations, and if the
    held coordinates of one piece hardly move in the other piece. The mean values of these coordinates may
    differ, because the frame may be fixed in the body. All free motion has one label. Neighbours have
    different labels.
    """
    fits = fit_spans(cells, np.array([(piece.start, piece.stop) for piece in pieces]))
    labels: list[int] = []
    for i, piece in enumerate(pieces):
        other = (j for j in range(i) if labels[j] not in (-1, labels[-1]))
        alike = {labels[j] for j in other if not piece.still and _same(cells, pieces, fits, i, j)}
        labels.append(-1 if piece.still else min(alike, default=max(labels, default=-1) + 1))
    return labels


def _same(cells: Cells, pieces: list[Piece], fits: Fits, i: int, j: int) -> bool:
    """Whether two pieces have the same constraint."""
    if pieces[i].held != pieces[j].held:
        return False
    translations, rotations = pieces[i].held
    for a, b in ((i, j), (j, i)):
        spans = [slice(pieces[k].start, pieces[k].stop) for k in (a, b)]
        weights = fits.weights[a, max(translations - 1, 0)]
        if _holds(cells.linear, weights, translations, cells.floor[0], spans) and _holds(
            cells.angular, fits.axes[a], rotations, cells.floor[1], spans
        ):
            return True
    return False


def _holds(features: np.ndarray, rows: np.ndarray, count: int, floor: float, spans: list[slice]) -> bool:
    """Whether ``count`` rows (T, 3, F) of any type are held in the first span and in the second span."""
    if count == 0:
        return True
    own, other = (
        np.stack([np.std(z[span] @ w[:count].T, axis=0).max() for z, w in zip(features, rows, strict=True)])
        for span in spans
    )
    return bool(np.any(np.maximum(own, other) <= max(C.alike * own.min(), 2 * floor)))

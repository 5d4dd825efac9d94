"""TODO."""

import numpy as np

from phsi_opt.data.measurements import Measurements
from phsi_opt.diagnosis.candidate import Candidate
from phsi_opt.diagnosis.criteria import AT_CORNER, CORNER
from phsi_opt.estimation.fit import Fit
from phsi_opt.initialization.relative_guesses import corner_widths
from phsi_opt.model.effect import Effect
from phsi_opt.model.model import Model
from phsi_opt.model.parameters import Share
from phsi_opt.screening.score_test import Screened


def simple_first(
    rows: list[tuple[Candidate, Screened]],
) -> list[tuple[Candidate, Screened]]:
    """The same order, but of dry frictions on one equation the one with fewer
    parameters comes first.
    """
    result = list(rows)
    for equation in {candidate.effect.equation for candidate, _ in rows}:
        at = [
            i
            for i, (c, _) in enumerate(rows)
            if c.effect.equation == equation and _is_dry(c.effect)
        ]
        for i, row in zip(
            at,
            sorted((rows[i] for i in at), key=lambda row: row[1].n_free),
            strict=True,
        ):
            result[i] = row
    return result


def simplest_dry(found: list[Screened]) -> list[Screened]:
    """Of dry frictions on one equation only the one with the fewest parameters; all
    else as it is.
    """
    dry = sorted(
        (one for one in found if _is_dry(one.effect)), key=lambda one: -one.n_free
    )
    simplest = {one.effect.equation: one for one in dry}
    return [
        one
        for one in found
        if not _is_dry(one.effect) or one is simplest[one.effect.equation]
    ]


def other_kinds(
    pair: tuple[Effect, ...], found: list[Screened]
) -> list[list[Screened]]:
    """The pair with another kind of dry friction on the same equation."""
    result = []
    for effect, beside in (pair, pair[::-1]):
        same = [
            o
            for o in found
            if _is_dry(effect)
            and _is_dry(o.effect)
            and o.effect.equation == effect.equation
        ]
        rest = [one for one in found if one.effect == beside]
        result += [[other, *rest] for other in same if other.effect != effect]
    return result


def _is_dry(effect: Effect) -> bool:
    inner = [
        parameter.guess for term in effect.term for parameter in term.inner.values()
    ]
    return any(isinstance(guess, Share) and bool(guess.sharper) for guess in inner)


def new_corners(model: Model, base: Model) -> dict[str, Share]:
    """Those that the base does not have."""
    return {
        name: guess
        for name, guess in corner_widths(model).items()
        if name not in base.entries
    }


def finer_at_corner(
    fit: Fit,
    data: Measurements,
    of: str,
    width: float,
    steps: tuple[np.ndarray, ...],
    at_corner: int = AT_CORNER,
) -> tuple[np.ndarray, ...]:
    """More steps in the gaps between samples in which ``of`` passes its corner: is
    zero, or near it.
    """
    formula, result = fit.model.function(of), []
    theta = fit.model.theta
    for run, x, n in zip(data.trajectories, fit.states, steps, strict=True):
        v = np.array(
            formula.map("v", "serial", len(x), [3], [])(
                x.T, run.u.T, run.t[None, :], theta
            )
        ).ravel()
        near = (v[1:] * v[:-1] < 0) | (
            np.minimum(np.abs(v[1:]), np.abs(v[:-1])) < CORNER * width
        )
        near = (
            np.convolve(near, np.ones(3))[1:-1] > 0
        )  # the corner may move to the gap beside
        result.append(np.where(near, np.maximum(n, at_corner), n))
    return tuple(result)

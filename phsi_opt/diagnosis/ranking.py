"""TODO."""

from dataclasses import replace

import numpy as np
from scipy.stats import false_discovery_control

from phsi_opt.diagnosis.candidate import Candidate
from phsi_opt.diagnosis.criteria import CLOSE, SEEN
from phsi_opt.estimation.fit import Fit
from phsi_opt.screening.score_test import Screen, Screened
from phsi_opt.statistics import TINY


def candidate_of(one: Screened, found: list[Screened], screen: Screen) -> Candidate:
    is_seen = one.p_value < SEEN  # what leaves nothing is like everything
    alike = tuple(
        str(o.effect)
        for o in found
        if o is not one and is_seen and screen.stands_in(one, o)
    )
    return Candidate(
        one.effect,
        one.coefficient,
        one.std_error,
        one.drop,
        one.values,
        alike,
        one.p_value,
    )


def new_names(old: Fit, new: Fit) -> list[str]:
    return [
        n
        for n, e in new.model.entries.items()
        if n not in old.model.entries and not e.parameter.fixed
    ]


def tied(one: Candidate, all_of: list[Candidate]) -> tuple[str, ...]:
    """What the data cannot tell from the candidate: by its trace, or by BIC after the
    re-fits.
    """
    close = [
        str(c.effect)
        for c in all_of
        if c is not one and abs(c.delta_bic - one.delta_bic) < CLOSE
    ]
    far = {str(c.effect) for c in all_of} - set(close)
    return tuple(
        dict.fromkeys(
            [*close, *(name for name in one.confusable_with if name not in far)]
        )
    )


def adjusted(candidates: list[Candidate]) -> tuple[Candidate, ...]:
    """P-values adjusted for the number of candidates, so that the share of false names
    is controlled.
    """
    if not candidates:
        return ()
    p = np.clip(np.nan_to_num([c.p_value for c in candidates], nan=1.0), 0.0, 1.0)
    return tuple(
        replace(c, p_value=float(q))
        for c, q in zip(candidates, false_discovery_control(p), strict=True)
    )


def size_of(fit: Fit, names: list[str], is_wave: bool) -> tuple[float, float]:
    """Coefficient (amplitude, for a sine and a cosine; the last of several) and its
    standard error.
    """
    at = [fit.names.index(n) for n in names if n in fit.names]
    values = np.array([fit.estimates[fit.names[i]] for i in at])
    covariance = fit.covariance[np.ix_(at, at)]
    if not is_wave:
        return float(values[-1]), float(np.sqrt(covariance[-1, -1]))
    size = float(np.linalg.norm(values))
    direction = values / max(size, TINY)
    return size, float(np.sqrt(direction @ covariance @ direction))

"""Where free runs begin on measurements that were not fitted."""

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.estimation import record

T = 0.05 * np.arange(160)
PUSHED = ph.mechanical(["q"], mass=2.0, forces="u - k*q - c*v", k=9.0, c=0.4)


def test_a_start_is_found_where_the_likelihood_finds_none(monkeypatch) -> None:
    """States of the missing force follow the data, and begin where no run fits best."""
    stiffening = PUSHED.add("cubic stiffness", "p")
    truth = stiffening.with_values({"cubic_stiffness_q": 6.0})
    rng = np.random.default_rng(17)
    u = 3 * np.sin(np.outer(T, (0.9, 2.3)) + rng.uniform(0, 6, 2)).sum(axis=1)
    x = ph.simulate(truth, T, [1.2, -1.0], u[:, None])
    x[:, 0] += 0.01 * rng.normal(size=160)
    x[:, 1] = np.nan
    data = ph.Measurements.from_arrays(T, x, u, states=["q", "p"], inputs=["u"])
    fit = ph.identify(PUSHED, data)
    other = ph.Measurements.from_arrays(
        T + 1.0, x, u, states=["q", "p"], inputs=["u"], names=["other"]
    )
    best = ph.compare(fit, other).rmse
    monkeypatch.setattr(record, "_most_likely_states", lambda *_: None)
    assert ph.compare(fit, other).rmse == pytest.approx(best, rel=1e-3)

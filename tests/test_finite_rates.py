"""Formulas that have no value at the measurements are refused, and named."""

import numpy as np
import pytest

import phsi_opt as ph


def swinging() -> ph.Measurements:
    t = np.arange(0, 5, 0.05)
    x = np.column_stack([np.cos(2 * t), np.full(t.shape, np.nan)])
    return ph.Measurements.from_arrays([t], [x], states=["q", "p"])


@pytest.mark.parametrize(
    ("energy", "said"),
    [
        ("k*exp(1000*q) + p**2/(2*m)", "term .*exp.* in H .*at [0-9]+ of 100 samples"),
        ("k*log(q)+ p**2/(2*m)", "in H .*at 53 of 100 samples"),
        ("k*sqrt(q)+ p**2/(2*m)", "in H .*q = -0.0292"),
        ("k*q**2/2 + p**2/(2*zero)", "in H .*100 of 100 samples.*zero = 0"),
        ("k*q**2/2 + p**2/(2*m)", None),
    ],
)
def test_what_has_no_value_is_refused(energy: str, said: str | None) -> None:
    known: dict[str, ph.Parameter | float] = {"k": ph.Parameter(1.0), "m": 1.0}
    known["zero"] = 0.0
    values = {name: value for name, value in known.items() if name in energy}
    model = ph.PseudoHamiltonian(
        states=["q", "p"], S=ph.canonical(1), H=ph.formula(energy, **values)
    )
    if said is None:
        ph.identify(model, swinging(), raise_on_failure=False)
        return
    with pytest.raises(ph.ModelError, match=f"(?s){said}"):
        ph.identify(model, swinging())

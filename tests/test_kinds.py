"""The kind of a state: told by the model, kept wherever it goes, read from units."""

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.estimation.fit_file import model_content, model_from
from phsi_opt.model.kinds import kind_of_unit


def heater(kind: Any = "thermal") -> ph.FirstOrder:
    return ph.FirstOrder(
        states=["T1", "T2"],
        F={
            "T1": ph.formula("-a*T1 + u", a=ph.Parameter(0.5, lower=0)),
            "T2": ph.formula("b*(T1 - T2)", b=ph.Parameter(0.3, lower=0)),
        },
        inputs=["u"],
        kind=kind,
    )


def circuit(kind: Any = "electrical") -> ph.PseudoHamiltonian:
    """A coil (flux phi) and a capacitor (charge q) at a voltage u."""
    return ph.PseudoHamiltonian(
        states=["q", "phi"],
        inputs=["u"],
        S=ph.canonical(1),
        H=ph.formula("q**2/2 + phi**2/2"),
        R={"phi": ph.formula("r", r=ph.Parameter(0.2, lower=0))},
        F={"phi": ph.formula("u")},
        kind=kind,
    )


def test_one_kind_is_that_of_all_states_and_a_mapping_that_of_some() -> None:
    assert heater().kind == {"T1": "thermal", "T2": "thermal"}
    assert heater({"T2": "thermal"}).kind == {"T2": "thermal"}
    assert heater(None).kind == {} == circuit({}).kind


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("thermic", "kind 'thermic' is unknown; .* Did you mean 'thermal'"),
        ({"T1": "Electrical"}, "kind of 'T1': 'Electrical' .* mean 'electrical'"),
        ({"T": "thermal"}, "kind of 'T', which is not a state .* Did you mean 'T"),
        (["thermal"], "must be one of mechanical, hydraulic, electrical, thermal"),
        ({"T1": None}, "kind of 'T1': None is unknown"),
    ],
)
def test_a_kind_that_there_is_not_is_refused(kind: Any, said: str) -> None:
    with pytest.raises(ph.ModelError, match=said):
        heater(kind)


@pytest.mark.parametrize("model", [heater(), circuit()], ids=["heater", "circuit"])
def test_a_model_that_changes_keeps_its_kinds(model: ph.Model) -> None:
    changed = model.frozen().dynamics().add("sensor delay", model.states[0])
    assert changed.kind == model.kind
    assert not set(changed.memory) & set(changed.kind)
    assert pickle.loads(pickle.dumps(model)) == model


@pytest.mark.parametrize("model", [heater(), circuit()], ids=["heater", "circuit"])
def test_the_content_of_a_model_holds_its_kinds_and_old_content_has_none(
    model: ph.Model,
) -> None:
    content = model_content(model)
    assert model_from(content) == model
    del content["kinds"]
    assert model_from(content).kind == {}


def test_a_fit_in_a_file_keeps_the_kinds_of_its_model(tmp_path: Path) -> None:
    t = np.linspace(0.0, 5.0, 101)
    model = heater().with_values({"a": 0.4})
    u = np.sin(t)[:, None]
    x = ph.simulate(model, t, [1.0, 0.0], u)
    x += 0.01 * np.random.default_rng(0).normal(size=x.shape)
    data = ph.Measurements.from_arrays(t, x, u, states=list(model.states), inputs=["u"])
    ph.identify(model, data).save(tmp_path / "fit.json")
    assert ph.Fit.load(tmp_path / "fit.json").model.kind == model.kind


@pytest.mark.parametrize(
    ("unit", "kind"),
    [
        *((unit, "mechanical") for unit in ("m", "mm", "rad", "deg", "m/s", "mrad/s")),
        *((unit, "mechanical") for unit in ("N", "kN", "N m", "N*s", "kg m/s", "rpm")),
        *((unit, "hydraulic") for unit in ("m^3", "m³", "L", "mL", "Pa", "mbar")),
        *((unit, "hydraulic") for unit in ("m**3/s", "L/min", "m^3/h")),
        *((unit, "electrical") for unit in ("A", "mA", "C", "Wb", "V s", "Ah")),
        *((unit, "thermal") for unit in ("K", "degC", "°C", "J", "kJ", "kWh")),
        *((unit, "") for unit in ("", "V", "mV", "1", "kg", "s", "%", "W")),
    ],
)
def test_a_unit_tells_the_kind_where_it_belongs_to_one_field(
    unit: str, kind: str
) -> None:
    assert kind_of_unit(unit) == kind

"""Measurements in the model's order: columns follow names, nothing is copied idly."""

import numpy as np
import pytest

import phsi_opt as ph
from phsi_opt.transcription.grid import AlignedData, aligned

X = np.arange(12.0).reshape(6, 2)
U = np.arange(12.0, 24.0).reshape(6, 2)


def data(states: tuple[str, ...], inputs: tuple[str, ...] = ()) -> ph.Measurements:
    return ph.Measurements.from_arrays(
        np.arange(6.0),
        X[:, : len(states)],
        U[:, : len(inputs)] if inputs else None,
        states=list(states),
        inputs=list(inputs),
    )


def model(inputs: tuple[str, ...] = ()) -> ph.PseudoHamiltonian:
    return ph.PseudoHamiltonian(
        states=("q", "p"),
        inputs=inputs,
        S=ph.canonical(1),
        H=ph.formula("k*q**2/2 + p**2/2", k=ph.Parameter(1.0)),
    )


def test_measurements_in_the_models_order_are_returned_as_they_are() -> None:
    record = data(("q", "p"))
    assert aligned(model(), record) is record


def test_columns_follow_the_names_of_states_and_inputs() -> None:
    run = aligned(model(("u", "v")), data(("p", "q"), ("v", "u"))).trajectories[0]
    np.testing.assert_array_equal(run.x, X[:, ::-1])
    np.testing.assert_array_equal(run.u, U[:, ::-1])


def test_units_stay_with_their_names_and_those_of_what_is_left_out_go() -> None:
    units = {"t": "s", "q": "m", "p": "kg m/s", "v": "V", "w": "A"}
    record = ph.Measurements.from_arrays(
        np.arange(6.0), X, U, states=["p", "q"], inputs=["w", "v"], units=units
    )
    found = aligned(model(("v",)), record)
    assert found.inputs == ("v",)
    assert found.units == {"t": "s", "q": "m", "p": "kg m/s", "v": "V"}
    np.testing.assert_array_equal(found.trajectories[0].u, U[:, 1:])


def test_what_is_no_model_or_no_measurements_is_refused() -> None:
    with pytest.raises(
        ph.ModelError,
        match=r"^model='spring' is no model; expected a PseudoHamiltonian or a "
        r"FirstOrder\.$",
    ):
        AlignedData.of("spring", data(("q", "p")))  # type: ignore[arg-type]
    with pytest.raises(
        ph.DataError,
        match=r"^data=7 are no Measurements; make them with Measurements\.from_arrays or "
        r"from_csv\.$",
    ):
        AlignedData.of(model(), 7)  # type: ignore[arg-type]


def test_the_memory_of_an_effect_is_added_as_never_measured() -> None:
    effects = {e.name: e for e in ph.catalogue(model()) if e.equation == "p"}
    larger = model().add(effects["hysteresis"])
    record = aligned(larger, data(("q", "p")))
    assert record.states == larger.states
    assert np.isnan(record.trajectories[0].x[:, 2:]).all()
    assert aligned(larger, record) is record


def test_states_and_inputs_that_do_not_match_are_named() -> None:
    with pytest.raises(
        ph.DataError,
        match=r"state 'p' of the model is not in the measurements \(q\); declare it "
        r"as not measured: states=\{\.\.\., 'p': None\}",
    ):
        aligned(model(), data(("q",)))
    with pytest.raises(
        ph.DataError,
        match=r"input 'u' of the model is not in the measurements \(v, w\)",
    ):
        aligned(model(("u",)), data(("q", "p"), ("v", "w")))
    with pytest.raises(ph.DataError, match=r"state 'q' .* measurements \(p, z\); decl"):
        aligned(model(), data(("p", "z")))
    only_q = ph.FirstOrder(("q",), {"q": ph.formula("-q")})
    with pytest.raises(
        ph.DataError, match="state 'p' of the measurements is not in the model; leave"
    ):
        aligned(only_q, data(("q", "p")))


def test_an_alignment_for_a_larger_model_is_made_once_and_for_the_same_model_not_at_all() -> (
    None
):
    effects = {e.name: e for e in ph.catalogue(model()) if e.equation == "p"}
    record = AlignedData.of(model(), data(("p", "q")))
    assert record.for_model(model()) is record
    assert record.for_model(model().add(effects["cubic stiffness"])) is record
    larger = model().add(effects["hysteresis"])
    extended = record.for_model(larger)
    assert extended.data.states == larger.states
    assert record.for_model(larger) is extended


def test_a_layout_without_further_nodes_is_the_one_that_was_made() -> None:
    record = AlignedData.of(model(), data(("q", "p")))
    ones = np.ones(5, dtype=int)
    assert record.grid_with([ones]) is record.grid
    assert record.grid_with([2 * ones]).n_nodes == 11

"""A neural force in turns with the solver."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import phsi_opt as ph
from phsi_opt.learning.hybrid import (
    Hybrid,
    hybrid,
)
from phsi_opt.learning.hybrid_network import NeuralForce

SMALL = NeuralForce(
    ("p",), ("q",), hidden=(20, 20), epochs=60, batch=64, learning_rate=5e-3
)
LIMIT = 0.8


def outside(q: np.ndarray) -> np.ndarray:
    return -np.clip(2 * q, -LIMIT, LIMIT)


def run(t: np.ndarray, x0: np.ndarray, forced: bool) -> np.ndarray:
    """q' = p, p' = -2 q - 0.2 p + F(q): R and the p^2 of H are free of the force."""

    def f(_: float, x: np.ndarray) -> list[float]:
        return [x[1], -2.0 * x[0] - 0.2 * x[1] + (outside(x[0]) if forced else 0.0)]

    solved = solve_ivp(
        f, (0, t[-1]), x0, "LSODA", t, rtol=1e-10, atol=1e-10, max_step=0.05
    )
    return np.asarray(solved.y.T)


def data(forced: bool = True) -> ph.Measurements:
    rng, t = np.random.default_rng(0), np.linspace(0.0, 4.0, 41)
    runs = [run(t, rng.uniform(-2, 2, 2), forced) for _ in range(10)]
    return ph.Measurements.from_arrays([t] * 10, runs, states=["q", "p"])


def model() -> ph.PseudoHamiltonian:
    """With a known stiffness: a network of q and a spring cannot be told apart."""
    H = ph.formula("q**2") + ph.polynomials(["p"], degree=3)
    return ph.PseudoHamiltonian(
        states=["q", "p"], S=ph.canonical(1), H=H, R=ph.damping("p")
    )


@pytest.fixture(scope="module")
def found() -> Hybrid:
    return hybrid(model(), data(), SMALL, pruning=ph.Pruning(0.05))


def test_dictionary_and_force_are_both_found_and_the_turns_end(found: Hybrid) -> None:
    assert set(found.model.free) == {"H[p**2]", "R_p"}
    assert found.values["H[p**2]"] == pytest.approx(0.5, rel=2e-3)
    assert found.values["R_p"] == pytest.approx(0.2, rel=2e-2)
    q = np.linspace(-1.5, 1.5, 31)
    error = found.force(np.column_stack([q, 0 * q]))[:, 0] - outside(q)
    assert np.sqrt(np.mean(error**2)) < 0.05 * 2 * LIMIT
    table = found.convergence
    assert found.converged and len(table) < 20
    assert table["loss"].iloc[-1] < 0.2 * table["loss"].iloc[0]
    changes = table["coefficient_change"]
    assert changes.iloc[-1] < 1e-3 < changes.iloc[0]


def test_the_force_can_be_switched_off(found: Hybrid) -> None:
    t, x0 = np.linspace(0, 8, 41), np.array([1.5, 0.0])
    with_it, without = run(t, x0, forced=True), run(t, x0, forced=False)
    assert np.abs(found.simulate(t, x0) - with_it).max() < 0.15
    assert np.abs(found.without_force().simulate(t, x0) - without).max() < 0.05
    assert np.abs(with_it - without).max() > 0.5


def test_without_an_outside_force_the_network_takes_nothing() -> None:
    measured = data(forced=False)
    clean = hybrid(model(), measured, SMALL)
    assert clean.values["R_p"] == pytest.approx(0.2, rel=1e-3)
    x = np.concatenate([run.x for run in measured.trajectories])
    assert np.sqrt(np.mean(clean.force(x) ** 2)) < 1e-2


def test_the_same_seed_gives_the_same_bits_and_another_seed_other_ones() -> None:
    few = NeuralForce(("p",), ("q",), hidden=(8,), epochs=4)
    a, b, c = (hybrid(model(), data(), few, seed=s, max_turns=2) for s in (3, 3, 4))
    assert a.values == b.values != c.values
    for own, other in zip(a.force.network.layers, b.force.network.layers, strict=True):
        assert np.array_equal(own[0], other[0]) and np.array_equal(own[1], other[1])


def test_equations_name_the_network_and_a_saved_hybrid_is_the_same_when_loaded(
    found: Hybrid, tmp_path: Path
) -> None:
    assert found.equations()[1].endswith("+ network_p(q)")
    assert "network" not in found.without_force().equations()[1]
    assert "alternations with the network" in str(found) and len(str(found)) < 2000
    found.save(tmp_path / "hybrid.json")
    again = Hybrid.load(tmp_path / "hybrid.json")
    t, x0 = np.linspace(0, 2, 11), np.array([1.0, 0.5])
    assert again.values == found.values and again.equations() == found.equations()
    assert np.array_equal(again.simulate(t, x0), found.simulate(t, x0))
    assert again.convergence.equals(found.convergence)


@pytest.mark.parametrize(("damage", "words"), [
    (lambda c: c.update(format="other"), "format"),
    (lambda c: c["force"].update(equations=["z"]), "'z'"),
    (lambda c: c["force"]["network"]["layers"].pop(), "weights of layer 2"),
    (lambda c: c["force"]["network"].update(layers=[]), ""),
    (lambda c: c["force"]["network"].update(shift=[0.0, 0.0]), "shift of the network"),
    # It would count for each of the 20 neurons.
    (lambda c: c["force"]["network"]["layers"][0].__setitem__(1, [0.5]), r"bias of layer 1 .*\(1,\); expected \(20,\)"),
    (lambda c: c.pop("fit"), "'fit'"),
])  # fmt: skip
def test_a_damaged_file_is_refused(
    found: Hybrid, tmp_path: Path, damage: Any, words: str
) -> None:
    path = tmp_path / "hybrid.json"
    found.save(path)
    content = json.loads(path.read_text())
    damage(content)
    path.write_text(json.dumps(content))
    with pytest.raises(ph.DataError, match=rf"hybrid\.json.*{words}"):
        Hybrid.load(path)


@pytest.mark.parametrize(("settings", "message"), [
    ({"equations": "p"}, "tuple of states"),
    ({"equations": ("p",), "hidden": ()}, "sizes of layers"),
    ({"equations": ("p",), "epochs": 0}, "above 0"),
    ({"equations": ("velocity",)}, "'velocity' is not a state"),
    ({"equations": ("p",), "variables": ("z",)}, "'z' is not a state, an input or"),
])  # fmt: skip
def test_bad_settings_are_refused(settings: dict, message: str) -> None:
    with pytest.raises(ph.ModelError, match=message):
        hybrid(model(), data(), NeuralForce(**settings))

"""Which state is what: read from the structure matrix and from where energy is lost."""

from typing import Any

import numpy as np
import pytest

from phsi_opt.errors import ModelError
from phsi_opt.model.model import FirstOrder, Model, PseudoHamiltonian
from phsi_opt.model.structure import (
    canonical,
    flow_states,
    forced_rows,
    position_of_momentum,
    position_rows,
    storage_states,
)
from phsi_opt.model.terms import damping, formula, polynomials


def spring() -> PseudoHamiltonian:
    return PseudoHamiltonian(
        states=["q", "p"],
        S=canonical(1),
        H=formula("q**2/2 + p**2/2"),
        R=damping("p"),
    )


def two_tanks() -> PseudoHamiltonian:
    """Two storages, and the flow in a pipe between them that loses energy."""
    return PseudoHamiltonian(
        states=["left", "right", "flow"],
        S=[[0, 0, -1], [0, 0, 1], [1, -1, 0]],
        H=formula("(left**2 + right**2 + flow**2)/2"),
        R=damping("flow"),
    )


def first_order() -> FirstOrder:
    return FirstOrder(states=["a", "b"], F={"a": polynomials(["a", "b"], 1)})


def test_canonical_is_the_structure_matrix_of_hamilton() -> None:
    np.testing.assert_array_equal(
        canonical(2), [[0, 0, 1, 0], [0, 0, 0, 1], [-1, 0, 0, 0], [0, -1, 0, 0]]
    )


@pytest.mark.parametrize("n", [0, -1, 1.0, "2"])
def test_canonical_needs_a_whole_number_of_positions(n: Any) -> None:
    with pytest.raises(ModelError, match="n is the number of positions"):
        canonical(n)


def test_only_equations_that_are_not_kinematic_may_lack_a_force() -> None:
    assert position_rows(spring()) == (0,)
    assert forced_rows(spring()) == (1,)
    assert forced_rows(first_order()) == (0, 1)


def test_a_pair_is_a_position_and_its_momentum_whatever_their_order() -> None:
    turned = PseudoHamiltonian(
        states=["p", "q"], S=-canonical(1), H=formula("q**2/2 + p**2/2")
    )
    assert position_of_momentum(spring()) == {"p": "q"}
    assert position_of_momentum(turned) == {"p": "q"}
    assert position_of_momentum(two_tanks()) == {}


@pytest.mark.parametrize(
    ("model", "flows", "storages"),
    [
        (spring(), (), ()),
        (two_tanks(), ("flow",), ("left", "right")),
        (first_order(), ("a", "b"), ("a", "b")),  # it does not tell which
    ],
    ids=["spring", "two tanks", "first order"],
)
def test_outside_the_pairs_are_flows_that_lose_energy_and_storages_that_do_not(
    model: Model, flows: tuple[str, ...], storages: tuple[str, ...]
) -> None:
    assert flow_states(model) == flows
    assert storage_states(model) == storages


def test_the_memory_of_an_effect_is_neither_forced_nor_a_storage() -> None:
    model = two_tanks().add("sensor delay", "left")
    assert forced_rows(model) == (0, 1, 2)
    assert storage_states(model) == ("left", "right")

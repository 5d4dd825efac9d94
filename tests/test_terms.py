"""Parameters, terms and dictionaries: what they hold, what they are called, and what
they refuse.
"""

import pickle
from math import comb
from typing import Any

import numpy as np
import pytest

from phsi_opt.errors import ModelError
from phsi_opt.model.parameters import Parameter, Scan, with_value
from phsi_opt.model.structure import canonical
from phsi_opt.model.terms import (
    Dictionary,
    Term,
    damping,
    formula,
    polynomials,
    trigonometric,
)
from phsi_opt.transcription.losses import MaximumLikelihood


def test_a_parameter_starts_at_its_value_or_where_its_bounds_are_nearest_to_zero() -> (
    None
):
    assert Parameter(2.0).start == 2.0
    assert Parameter().start == 0.0
    assert Parameter(lower=0.5).start == 0.5
    assert Parameter(upper=-0.5).start == -0.5


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"value": np.nan}, "value=nan is not finite"),
        ({"value": np.inf}, "value=inf is not finite"),
        ({"value": "two"}, "value=two is not a number"),
        ({"value": 10**400}, "is not a number"),
        ({"lower": np.nan}, "lower=nan is not finite"),
        ({"lower": 2.0, "upper": 1.0}, "bounds are crossed: lower=2 is above upper=1"),
        ({"value": 3.0, "upper": 1.0}, r"value 3 lies outside its bounds \[-inf, 1\]"),
        ({"fixed": True}, "a fixed parameter needs a value"),
    ],
)
def test_a_parameter_that_contradicts_itself_is_refused(
    arguments: dict[str, Any], message: str
) -> None:
    with pytest.raises(ModelError, match=message):
        Parameter(**arguments)


@pytest.mark.parametrize(("n", "degree"), [(1, 1), (1, 4), (2, 3), (3, 2)])
def test_polynomials_are_all_monomials_up_to_the_degree_and_each_once(
    n: int, degree: int
) -> None:
    names = [f"x{i}" for i in range(n)]
    bodies = [term.body for term in polynomials(names, degree, constant=True)]
    assert len(bodies) == len(set(bodies)) == comb(n + degree, degree)
    assert bodies[0] == "1"
    assert [t.body for t in polynomials(names, degree)] == bodies[1:]


def test_monomials_are_written_as_formulas() -> None:
    assert [t.body for t in polynomials(["q", "p"], 2)] == [
        "q",
        "p",
        "q**2",
        "q*p",
        "p**2",
    ]


def test_a_trigonometric_pair_shares_one_frequency_that_is_scanned() -> None:
    sine, cosine = trigonometric("t")
    assert (sine.body, cosine.body) == ("sin(omega_t*t)", "cos(omega_t*t)")
    assert dict(sine.inner) == dict(cosine.inner)
    assert sine.inner["omega_t"].guess == Scan("t")
    assert [t.body for t in trigonometric("q", n=2)][2] == "sin(omega_q2*q)"
    assert trigonometric("t", frequency=2.0).terms[0].inner["omega_t"].value == 2.0


def test_damping_is_never_negative() -> None:
    terms = damping("p1", "p2")
    assert list(terms) == ["p1", "p2"]
    coefficient = terms["p1"].terms[0].coefficient
    assert coefficient is not None
    assert coefficient.lower == 0.0


def test_one_name_and_a_list_of_names_are_the_same() -> None:
    assert damping("q", "p") == damping(["q", "p"])
    assert damping("p") == damping(["p"])
    assert polynomials("q", 2) == polynomials(["q"], 2)
    assert trigonometric("t") == trigonometric(["t"])
    both = trigonometric(["t", "q"], n=2)
    assert both == trigonometric("t", n=2) + trigonometric("q", n=2)


def test_coefficients_are_named_by_place_and_body() -> None:
    (constant,), (q,) = Dictionary((Term("1", Parameter()),)), polynomials(["q"], 1)
    assert constant.coefficient_name("R_p") == "R_p"
    assert q.coefficient_name("H") == "H[q]"
    assert Term("q", Parameter(), name="k").coefficient_name("H") == "k"
    assert trigonometric("t").terms[0].inner_name("omega_t", "F_p") == "F_p.omega_t"
    assert formula("k*q", k=1.0).terms[0].inner_name("k", "H") == "k"


def test_a_plain_number_in_a_formula_is_a_fixed_parameter() -> None:
    (term,) = formula("k*q", k=2.5)
    assert term.inner["k"] == Parameter(2.5, fixed=True)
    assert term.is_formula


def test_setting_a_value_keeps_the_bounds() -> None:
    (term,) = damping("p")["p"]
    assert term.coefficient is not None
    assert with_value(term.coefficient, -1e-9) == Parameter(0.0, lower=0.0)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: polynomials(["q", "q"], 2), "each only once"),
        (lambda: polynomials([], 2), "at least one name"),
        (lambda: polynomials(["sin"], 2), "variable 'sin' is not a usable name"),
        (lambda: polynomials(["q q"], 2), "variable 'q q' is not a usable name"),
        (lambda: polynomials(["q"], 0), "polynomials: degree=0 is not possible"),
        (lambda: polynomials(["q"], 1.5), "polynomials: degree=1.5 is not possible"),  # type: ignore[arg-type]
        (lambda: polynomials(["q"], 10**9), "degree=1000000000 .* is beyond 64"),
        (lambda: polynomials(["q"], 10**5000), "degree=a number beyond 10.* beyond 64"),
        (
            lambda: polynomials([f"x{i}" for i in range(20)], 5),
            "degree=5 in 20 variables would have 53130 terms; at most 5000",
        ),
        (lambda: polynomials(["q"], True), "polynomials: degree=True is not possible"),
        (
            lambda: trigonometric(["t", "q"], n=10**9),
            "n=1000000000 for 2 variables would have 4000000000 terms",
        ),
        (lambda: trigonometric("t", n=10**5000), "n=a number beyond 10"),
        (lambda: Dictionary(5001 * tuple(formula("q"))), "would have 5001 terms"),
        (lambda: canonical(10**9), r"canonical: n=1000000000 .* from 1 to 1000"),
        (lambda: MaximumLikelihood(steps=10**9), "steps=1000000000 .* from 1 to 1000"),
        (lambda: damping("q", ["q", "p"]), "each only once"),
        (lambda: trigonometric("t", n=0), "trigonometric: n=0 is not possible"),
        (
            lambda: polynomials(["q"], 2) + polynomials(["q"], 1),
            "term 'q' stands in the dictionary twice",
        ),
        (lambda: polynomials(["q"], 2) + 3, "3 cannot be added to a dictionary"),  # type: ignore[operator]
        (
            lambda: formula("k*q", k=1.0, m=2.0),
            "parameter 'm' does not occur in 'k\\*q'",
        ),
    ],
)
def test_a_dictionary_that_makes_no_sense_is_refused(make: Any, message: str) -> None:
    with pytest.raises(ModelError, match=message):
        make()


def test_a_term_cannot_be_changed_and_can_be_pickled() -> None:
    (term,) = formula("k*q", k=1.0)
    with pytest.raises(TypeError):
        term.inner["k"] = Parameter(2.0)  # type: ignore[index]
    assert pickle.loads(pickle.dumps(term)) == term


def test_what_was_not_chosen_is_not_printed() -> None:
    spring = formula("k*q**2/2", k=Parameter(2.0, lower=0, unit="N/m"))
    assert repr(Parameter()) == "Parameter()"
    assert repr(spring) == (
        "Dictionary(terms=(Term(body='k*q**2/2', "
        "inner={'k': Parameter(value=2.0, lower=0.0, unit='N/m')}),))"
    )

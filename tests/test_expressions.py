"""Formulas are data: read through a whitelist, the same in every backend, never run."""

import casadi as ca
import numpy as np
import pytest
import sympy as sp

import phsi_opt as ph
from phsi_opt.model.expressions import FUNCTIONS, NUMPY, evaluate, names_of, parse
from phsi_opt.model.sympy_backend import SYMPY

FORMULAS = [
    *(f"{name}(0.3 + q**2)" for name in FUNCTIONS if name not in ("min", "max")),
    "min(q, p) + max(q, 2*p)",
    "-q**2/2 + 3*p*q - (+p)",
    "q**-2 + 2**q",
    "pi*q/4 - 1e-3",
    "q**0.5*p",
    "exp(-q**2)*sin(3*p)",
]


@pytest.mark.parametrize("text", FORMULAS)
def test_casadi_sympy_and_numpy_agree(text: str) -> None:
    q, p = 0.7, -0.4
    x = ca.SX.sym("x", 2)
    by_casadi = float(
        ca.Function("f", [x], [evaluate(text, {"q": x[0], "p": x[1]})])([q, p])
    )
    symbols = sp.symbols("q p")
    by_sympy = float(
        evaluate(text, dict(zip("qp", symbols, strict=True)), SYMPY).subs(
            {"q": q, "p": p}
        )
    )
    by_numpy = evaluate(text, {"q": q, "p": p}, NUMPY)
    # The same few operations in three libraries: rounding only.
    assert by_casadi == pytest.approx(by_numpy, rel=1e-14)
    assert by_sympy == pytest.approx(by_numpy, rel=1e-14)


def test_numpy_evaluates_whole_arrays() -> None:
    q = np.linspace(0.0, 1.0, 5)
    np.testing.assert_array_equal(evaluate("2*q + 1", {"q": q}, NUMPY), 2 * q + 1)


def test_names_are_those_that_need_a_value() -> None:
    assert names_of("k*sin(omega*t) + pi*q**2") == {"k", "omega", "t", "q"}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is not text"),
        ("   ", "is not text"),
        ("q^2", r"Write a power as \*\*"),
        ("q +", "cannot be read"),
        ("q; p", "cannot be read"),
        ("sinn(q)", r"function 'sinn'.*Did you mean 'sin'\?"),
        ("sin(q, p)", r"sin takes 1 argument\(s\)"),
        ("min(q)", r"min takes 2 argument\(s\)"),
        ("sin(x=q)", "takes 1 argument"),
        ("sin(*q)", "not allowed"),
        ("q.real", "not allowed"),
        ("q[0]", "not allowed"),
        ("q < p", "not allowed"),
        ("not q", "not allowed"),
        ("~q", "not allowed"),
        ("q // 2", "operator"),
        ("q @ p", "operator"),
        ("'q'", "not a finite number"),
        ("True*q", "not a finite number"),
        ("1j*q", "not a finite number"),
        ("1e999*q", "not a finite number"),
        ("9" * 400, "not a finite number"),
        ("q**65", "beyond 64"),
        ("q**(8*9)", "beyond 64"),
        ("q**-65", "beyond 64"),
        ("q**(2**7)", "beyond 64"),
        ("((9**64)**64)**64", "no finite value"),
        ("q + 1/0", "no finite value"),
        ("(-1)**0.5*q", "no finite value"),
        ("log(0 - 1)*2 + q", "no finite value"),
        ("-" * 300 + "q", "nested too deeply"),
        ("+".join(["q"] * 300), "nested too deeply"),
        ("q" * 10_001, "too long"),
        ("(" * 9_000, r"^formula '\({60}\.\.\.' cannot be read"),
        ("\ud800*q", "no character of a text"),
        ("9**9**9", "beyond 64"),
        ("((((10/9)**16)**16)**16)*q", "too many digits"),
        ("(((1/9)**64)**64)**64*q", "too many digits"),
        ("((((2*q)**64)**64)**64)**64", "too many digits"),
        ("sqrt(((9*q)**64)**64)", "too many digits"),
        ("__import__('os')", "is not known"),
        ("(lambda: 1)()", "is not known"),
        ("[q for q in p]", "not allowed"),
    ],
)
def test_what_is_not_a_formula_is_refused(text: str, message: str) -> None:
    with pytest.raises(ph.ModelError, match=message):
        parse(text)


def test_an_exponent_of_at_most_64_is_allowed() -> None:
    assert evaluate("q**(2**3)", {"q": 2.0}, NUMPY) == 256.0
    assert evaluate("q**-64", {"q": 1.0}, NUMPY) == 1.0


def test_an_unknown_name_is_refused_with_the_nearest_one() -> None:
    with pytest.raises(ph.ModelError, match=r"name 'omgea' .* Did you mean 'omega'\?"):
        evaluate("sin(omgea)", {"omega": 1.0}, NUMPY)

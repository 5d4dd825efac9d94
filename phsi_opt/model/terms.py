"""Terms, parameters and dictionaries: what a model is made of.

A term is a body (a formula as text) times a coefficient, with inner parameters such as
a frequency. A dictionary is a sum of terms. Bodies are read by `expressions`, so
values, names, LaTeX and files share one table. Where a term acts (H, R, F) is the
model's business.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations_with_replacement
from types import MappingProxyType
from typing import Any

from phsi_opt.errors import ModelError
from phsi_opt.model.expressions import FUNCTIONS, names_of
from phsi_opt.model.parameters import Parameter, Scan


@dataclass(frozen=True)
class Term:
    """``coefficient * body``, or the body alone (a formula) where ``coefficient`` is
    None.

    ``inner`` are the parameters inside the body. Those of a formula are known to the
    whole model by their name; those of a dictionary term belong to the place where it
    stands. ``name`` replaces the automatic name of the coefficient.
    """

    body: str
    coefficient: Parameter | None = None
    inner: Mapping[str, Parameter] = field(default_factory=dict)
    name: str = ""

    def __post_init__(self) -> None:
        used = names_of(self.body)
        object.__setattr__(self, "inner", MappingProxyType(dict(self.inner)))
        for name in self.inner:
            if name not in used:
                raise ModelError(
                    f"parameter {name!r} does not occur in {self.body!r}; remove it or correct its name."
                )

    def __reduce__(self) -> tuple[Any, ...]:  # a mappingproxy cannot be pickled
        return Term, (self.body, self.coefficient, dict(self.inner), self.name)

    @property
    def is_formula(self) -> bool:
        """Whether the body stands alone, without a coefficient of its own."""
        return self.coefficient is None

    def coefficient_name(self, place: str) -> str:
        """Name of the coefficient at a place such as 'H' or 'F_p'."""
        return self.name or (place if self.body == "1" else f"{place}[{self.body}]")

    def inner_name(self, name: str, place: str) -> str:
        """Name of an inner parameter in the model."""
        return name if self.is_formula else f"{self.name or place}.{name}"


@dataclass(frozen=True)
class Dictionary:
    """A sum of terms; ``+`` joins dictionaries."""

    terms: tuple[Term, ...] = ()

    def __post_init__(self) -> None:
        seen: set[tuple[str, str]] = set()
        for term in self.terms:
            if not term.is_formula and (term.body, term.name) in seen:
                raise ModelError(
                    f"term {term.body!r} stands in the dictionary twice, so its coefficients cannot be told apart; "
                    "keep one (several frequencies: trigonometric('t', n=2))."
                )
            seen.add((term.body, term.name))

    def __add__(self, other: "Dictionary") -> "Dictionary":
        if not isinstance(other, Dictionary):
            raise ModelError(
                f"{other!r} cannot be added to a dictionary; write formula(...) or polynomials(...)."
            )
        return Dictionary(self.terms + other.terms)

    def __len__(self) -> int:
        return len(self.terms)

    def __iter__(self) -> Iterator[Term]:
        return iter(self.terms)


def formula(expression: str, **parameters: Parameter | float) -> Dictionary:
    """A term written as text, with named parameters: ``formula("k*q**2/2",
    k=Parameter(1.0, lower=0))``.

    A plain number is a known, fixed value. The text is read through a whitelist (see
    `expressions`). Inside F and R the efforts dH/dx are known as ``dH_dq`` and so on.
    """
    made = {name: _parameter(value) for name, value in parameters.items()}
    return Dictionary((Term(expression, None, made),))


def _parameter(value: Parameter | float) -> Parameter:
    return value if isinstance(value, Parameter) else Parameter(value, fixed=True)


def polynomials(
    variables: Sequence[str], degree: int, constant: bool = False
) -> Dictionary:
    """All monomials of total degree 1 to ``degree`` in the variables (and 1 if
    ``constant``), with coefficients.
    """
    names = _variables(variables)
    if not isinstance(degree, int) or degree < 1:
        raise ModelError(
            f"degree={degree!r} of polynomials is not a whole number of at least 1."
        )
    bodies = ["1"] if constant else []
    for total in range(1, degree + 1):
        bodies += [
            _monomial(chosen) for chosen in combinations_with_replacement(names, total)
        ]
    return Dictionary(tuple(Term(body, Parameter()) for body in bodies))


def _variables(variables: Iterable[str]) -> list[str]:
    names = [variables] if isinstance(variables, str) else list(variables)
    for name in names:
        if not isinstance(name, str) or not name.isidentifier() or name in FUNCTIONS:
            raise ModelError(
                f"variable {name!r} is not a usable name; expected letters, digits and underscores."
            )
    if not names or len(set(names)) != len(names):
        raise ModelError(
            f"variables {names!r} must be at least one name, and each only once."
        )
    return names


def _monomial(chosen: Sequence[str]) -> str:
    powers = {name: chosen.count(name) for name in dict.fromkeys(chosen)}
    return "*".join(
        name if power == 1 else f"{name}**{power}" for name, power in powers.items()
    )


def trigonometric(
    variable: str = "t", n: int = 1, frequency: float | None = None
) -> Dictionary:
    """``n`` pairs a sin(omega x) + b cos(omega x) with a free frequency each: free
    amplitude and free phase.

    amplitude = sqrt(a^2 + b^2), phase = atan2(b, a). The pair is the form in which the
    phase has no needle to miss. The starting frequency (rad per unit of the variable)
    comes from a scan over the data unless ``frequency`` is given.
    """
    (name,) = _variables([variable])
    if not isinstance(n, int) or n < 1:
        raise ModelError(
            f"n={n!r} of trigonometric is not a whole number of at least 1."
        )
    terms = []
    for k in range(1, n + 1):
        omega = f"omega_{name}" if n == 1 else f"omega_{name}{k}"
        inner = {omega: Parameter(frequency, lower=0.0, unit="", guess=Scan(name))}
        terms += [
            Term(f"{wave}({omega}*{name})", Parameter(), inner)
            for wave in ("sin", "cos")
        ]
    return Dictionary(tuple(terms))


def damping(*states: str) -> dict[str, Dictionary]:
    """Constant damping R_ii >= 0 on the named states: dx_i/dt = ... - R_ii dH/dx_i."""
    return {
        name: Dictionary((Term("1", Parameter(None, lower=0.0)),))
        for name in _variables(states)
    }


def with_parameters(
    term: Term, place: str, change: Callable[[str, Parameter], Parameter]
) -> Term:
    """The term with ``change`` applied to each of its parameters, which it gets with
    their names in the model.
    """
    coefficient = term.coefficient
    if coefficient is not None:
        coefficient = change(term.coefficient_name(place), coefficient)
    inner = {
        name: change(term.inner_name(name, place), p) for name, p in term.inner.items()
    }
    return replace(term, coefficient=coefficient, inner=inner)

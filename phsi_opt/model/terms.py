"""Terms and dictionaries: the sums that a model is made of, and how they are written.

A term is a body (a formula as text) times a coefficient, with inner parameters such as
a frequency. A dictionary is a sum of terms. Bodies are read by ``expressions``, so
values, names, LaTeX and files share one table. Where a term acts (H, R, F, sensor) is
the model's business.
"""

import copyreg
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import combinations_with_replacement
from math import comb
from types import MappingProxyType
from typing import Any

from phsi_opt.arguments import is_of, require_count, typed
from phsi_opt.errors import ModelError, shown
from phsi_opt.model.expressions import FUNCTIONS, MAX_EXPONENT, names_of, needs_brackets
from phsi_opt.model.parameters import Parameter, Scan
from phsi_opt.presentation.numbers import short_repr

# Terms. With as many coefficients the derivatives of 10 000 samples of two states take
# 80 MB, and the checks of a study file seconds, which grow with the square.
LARGEST_DICTIONARY = 500


def read_only(content: Mapping[str, Any]) -> MappingProxyType[str, Any]:
    """A mapping that cannot be changed, in terms, effects and models."""
    return MappingProxyType(dict(content))


# Python itself cannot pickle it.
copyreg.pickle(MappingProxyType, lambda one: (read_only, (dict(one),)))


@dataclass(frozen=True)
class Term:
    """``coefficient * body``, or the body alone (a formula) without a coefficient.

    The inner parameters of a formula are known to the whole model by their name; those
    of a dictionary term belong to the place where it stands.

    Args:
        body: a formula, see ``expressions``.
        coefficient: the factor of the body; None for a formula.
        inner: the parameters inside the body, or in the direction along which the term
            stands, by name.
        name: replaces the automatic name of the coefficient.

    Raises:
        ModelError: the body cannot be read.
    """

    body: str
    coefficient: Parameter | None = None
    inner: Mapping[str, Parameter] = field(default_factory=dict)
    name: str = ""

    def __post_init__(self) -> None:
        names_of(self.body)  # refuses what cannot be read
        object.__setattr__(self, "inner", read_only(self.inner))

    def __repr__(self) -> str:
        return short_repr(self)

    @property
    def is_formula(self) -> bool:
        """Whether the body stands alone, without a coefficient of its own."""
        return self.coefficient is None

    def product(self, coefficient: str, body: str) -> str:
        """The term as text, with the texts of its coefficient and of its body."""
        if self.body == "1":
            return coefficient
        return f"{coefficient}*{f'({body})' if needs_brackets(self.body) else body}"

    @property
    def parameters(self) -> dict[str, Parameter]:
        """All its parameters by their names in it; the coefficient is called ""."""
        coefficient = {} if self.coefficient is None else {"": self.coefficient}
        return {**coefficient, **self.inner}

    def parameter_name(self, place: str, inner: str = "") -> str:
        """Name in the model of a parameter of the term at a place such as 'F_p'."""
        if inner:
            return inner if self.is_formula else f"{self.name or place}.{inner}"
        return self.name or (place if self.body == "1" else f"{place}[{self.body}]")

    def with_parameters(
        self, place: str, change: Callable[[str, Parameter], Parameter]
    ) -> "Term":
        """The term with each parameter changed.

        Args:
            place: where the term stands.
            change: a parameter's name in the model and the parameter -> the new one.
        """
        changed = {}
        for inner, parameter in self.parameters.items():
            changed[inner] = change(self.parameter_name(place, inner), parameter)
        return replace(self, coefficient=changed.pop("", None), inner=changed)


@dataclass(frozen=True)
class Dictionary:
    """A sum of terms; ``+`` joins dictionaries.

    Raises:
        ModelError: a term with a coefficient stands in it twice, or there are more than
            500 terms.
    """

    terms: tuple[Term, ...] = ()

    def __post_init__(self) -> None:
        check_number_of_terms(len(self.terms))
        known: set[tuple[str, str]] = set()
        for term in self.terms:
            key = (term.body, term.name)
            if not term.is_formula and key in known:
                raise ModelError(
                    f"term {term.body!r} is in the dictionary twice, so its two "
                    "coefficients cannot be distinguished; keep one (several "
                    "frequencies: trigonometric('t', n=2))."
                )
            known.add(key)

    @typed
    def __add__(self, other: "Dictionary") -> "Dictionary":
        return Dictionary(self.terms + other.terms)

    def __len__(self) -> int:
        return len(self.terms)

    def __iter__(self) -> Iterator[Term]:
        return iter(self.terms)


# ---- ways to write a dictionary ------------------------------------------------------


@typed
def formula(expression: str, **parameters: Parameter | float) -> Dictionary:
    """A term written as text: ``formula("k*q**2/2", k=Parameter(1.0, lower=0))``.

    Args:
        expression: the text, parsed with a list of allowed functions (see
            ``expressions``). In F and R the efforts dH/dx are called ``dH_dq`` and so
            on.
        ***parameters: the parameters by name; a number is a fixed value.

    Raises:
        ModelError: the text cannot be parsed, or does not contain one of the
            parameters.

    Examples:
        >>> spring = ph.formula("k*q**2/2", k=ph.Parameter(1.0, lower=0, unit="N/m"))
        >>> spring.terms[0].inner["k"].start
        1.0
    """
    inner = {name: parameter_of(value) for name, value in parameters.items()}
    return Dictionary((Term(expression, None, inner),))


def parameter_of(value: Parameter | float) -> Parameter:
    """A parameter as it is; a number as a known one."""
    return value if isinstance(value, Parameter) else Parameter(value, fixed=True)


@typed
def polynomials(
    variables: str | Iterable[str], degree: int, constant: bool = False
) -> Dictionary:
    """All monomials of total degree 1 to ``degree``, each with a coefficient.

    Args:
        variables: one name, or several.
        degree: the largest total degree.
        constant: whether 1 is a term too.

    Raises:
        ModelError: names that cannot be used, a degree below 1 or beyond 64, or more
            than 500 terms.

    Examples:
        >>> [term.body for term in ph.polynomials(["q", "p"], degree=2)]
        ['q', 'p', 'q**2', 'q*p', 'p**2']
    """
    names = _variables(variables)
    require_count("polynomials: degree", degree)
    if degree > MAX_EXPONENT:
        raise ModelError(
            f"degree={shown(degree)} of polynomials exceeds {MAX_EXPONENT}; "
            "rescale the variables and choose a lower degree."
        )
    n_terms = comb(len(names) + degree, degree)
    check_number_of_terms(
        n_terms, f"polynomials of degree={degree} in {len(names)} variables"
    )
    bodies = ["1"] if constant else []
    for total in range(1, degree + 1):
        for factors in combinations_with_replacement(names, total):
            powers = []
            for name, n in Counter(factors).items():
                powers.append(f"{name}**{n}" if n > 1 else name)
            bodies.append("*".join(powers))
    return Dictionary(tuple(Term(body, Parameter()) for body in bodies))


@typed
def trigonometric(
    variables: str | Iterable[str] = "t", n: int = 1, frequency: float | None = None
) -> Dictionary:
    """``n`` pairs a sin(omega x) + b cos(omega x), each with a free frequency.

    The amplitude sqrt(a^2 + b^2) and the phase atan2(b, a) are free; in this form the
    model is linear in a and b.

    Args:
        variables: one name x, or several, each of which gets its pairs.
        n: number of pairs per variable.
        frequency: starting value of omega, in rad per unit of the variable; default:
            from a scan over the data.

    Raises:
        ModelError: names that cannot be used, n below 1, or more than 500 terms.

    Examples:
        >>> [term.body for term in ph.trigonometric("t")]
        ['sin(omega_t*t)', 'cos(omega_t*t)']
    """
    names = _variables(variables)
    require_count("trigonometric: n", n)
    n_terms = 2 * n * len(names)
    check_number_of_terms(
        n_terms, f"trigonometric of n={shown(n)} for {len(names)} variables"
    )
    terms: list[Term] = []
    for name in names:
        for number in range(1, n + 1):
            omega = f"omega_{name}" if n == 1 else f"omega_{name}{number}"
            inner = {omega: Parameter(frequency, lower=0.0, guess=Scan(name))}
            for wave in ("sin", "cos"):
                terms.append(Term(f"{wave}({omega}*{name})", Parameter(), inner))
    return Dictionary(tuple(terms))


def check_number_of_terms(n_terms: int, what: str = "a dictionary") -> None:
    """Refuse more terms than ``LARGEST_DICTIONARY``, in a dictionary or a model."""
    if n_terms > LARGEST_DICTIONARY:
        raise ModelError(
            f"{what} would have {shown(n_terms)} terms; at most "
            f"{LARGEST_DICTIONARY} are allowed. Choose a smaller dictionary."
        )


def damping(*states: str | Iterable[str]) -> dict[str, Dictionary]:
    """Constant damping R_ii >= 0 on the named states: dx_i/dt = ... - R_ii dH/dx_i.

    Args:
        *states: one name, or several, or a list of names.

    Raises:
        ModelError: names that cannot be used.

    Examples:
        >>> friction = ph.damping("p")
        >>> friction["p"].terms[0].coefficient
        Parameter(lower=0.0)
    """
    constant = Dictionary((Term("1", Parameter(lower=0.0)),))
    return dict.fromkeys(_variables(*states), constant)


def _variables(*variables: str | Iterable[str]) -> list[str]:
    """The names given, each by itself or in lists."""
    names: list[str] = []
    for given in variables:
        names.extend(given if is_of(given, Iterable[Any]) else [given])  # type: ignore[list-item]
    for name in names:
        if not isinstance(name, str) or not name.isidentifier() or name in FUNCTIONS:
            raise ModelError(
                f"variable {shown(name)} is not a usable name; "
                "expected letters, digits and underscores."
            )
    if not names or len(set(names)) != len(names):
        raise ModelError(
            f"variables {shown(names)} must have at least one name, and none twice."
        )
    return names

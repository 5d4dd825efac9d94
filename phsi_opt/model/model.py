"""The models that a user writes: with an energy, and without.

``PseudoHamiltonian`` is dx/dt = (S - R(x)) grad H(x) + F(x, t, u), ``FirstOrder`` is
dx/dt = F(x, t, u). Both are frozen records (``base``) with CasADi functions
(``symbolic``), and know the effects that could be added to them (``catalogue``).
Nothing here knows of data, losses or solvers.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import casadi as ca
import numpy as np

from phsi_opt.arguments import is_of, require, typed
from phsi_opt.errors import ModelError, shown
from phsi_opt.model.base import BaseModel, checked_structure
from phsi_opt.model.catalogue import effect_named
from phsi_opt.model.effect import Effect
from phsi_opt.model.expressions import evaluate
from phsi_opt.model.symbolic import Expressions, function_of, model_summary, with_slopes
from phsi_opt.model.terms import Dictionary
from phsi_opt.presentation.summary import Summarised, Summary

Terms = Dictionary | str  # a text is a formula, see `Model`
TermsByState = Mapping[str, Terms]


@dataclass(frozen=True, kw_only=True, init=False, repr=False)
class Model(BaseModel, Summarised):
    """Base class of `PseudoHamiltonian` and `FirstOrder`.

    Terms are a `formula`, a dictionary such as `polynomials`, or a text: a formula
    whose names are states, inputs, the time ``t``, efforts such as ``dH_dp``, and
    parameters. Parameters that no other formula of the model defines are free, without
    bounds; one that is a whole loss, ``R={"p": "c"}``, has the lower bound 0.

    ``sensor`` contains the error terms of the sensors by state: measured = state +
    sensor terms, such as an offset ``formula("b", b=Parameter(0.0))`` or a gain
    ``formula("(g - 1)*q", g=Parameter(1.0))``. ``memory`` names the states that are the
    memory of an effect (a lag, a hysteresis): their equations are in F, and the
    measurements need not contain them.

    Raises:
        ModelError: see the two classes.
    """

    @typed
    def __init__(
        self,
        *,
        states: Sequence[str],
        inputs: Sequence[str] = (),
        R: TermsByState | None = None,
        F: TermsByState | None = None,
        sensor: TermsByState | None = None,
        S: Any = None,
        H: Terms | None = None,
        memory: Sequence[str] = (),
        kind: str | Mapping[str, str] | None = None,
    ) -> None:
        S, exchanges = _split_structure(S, states)
        F = {**(F or {}), **exchanges}
        terms: dict[str, Any] = {"R": R or {}, "F": F, "sensor": sensor or {}}
        terms["H"] = Dictionary() if H is None else H
        terms |= {"S": S, "kind": {} if kind is None else kind}
        super().__init__(states=states, inputs=inputs, memory=memory, **terms)

    def _summary(self) -> Summary:
        return model_summary(self)

    @typed
    def add(self, effect: Effect | str, equation: str | None = None) -> Self:
        """A new model with the effect's terms in its slot.

        The effect's memory becomes further states at the end.

        Args:
            effect: an `Effect`, or the name of one in the catalogue.
            equation: the state in whose equation an effect of that name acts; not
                needed where the catalogue has it for one equation only. Without the
                units of data its size is a rate in a model without an energy.

        Raises:
            ModelError: the catalogue has no such effect for this model, or has it for
                several equations and none is given; the effect's equation is unknown.
        """
        if isinstance(effect, str):
            return super().add(effect_named(self, effect, equation))
        if equation not in (None, effect.equation):
            raise ModelError(
                f"effect {effect.name!r} acts on {effect.equation!r}, "
                f"not on {equation!r}; leave the equation out."
            )
        return super().add(effect)

    def rhs(self) -> ca.Function:
        """CasADi function (x, u, t, theta) -> dx/dt, theta in the order of `free`."""
        return self._made("rhs", lambda one: ca.vertcat(*map(ca.SX, one.rates)))

    def rhs_slopes(self, argument: str) -> ca.Function:
        """CasADi function (x, u, t, theta) -> dx/dt, and its slopes row by row.

        In "x", "u", "t" or "theta".
        """
        key = ("slopes", argument)
        return self.built(key, lambda: with_slopes(self.rhs(), argument))

    def output(self) -> ca.Function:
        """CasADi function (x, u, t, theta) -> what the sensors show of the states x."""
        return self._made("output", lambda one: one.shown)

    def function(self, *formulas: str) -> ca.Function:
        """CasADi function (x, u, t, theta) -> values of the formulas, as one column.

        The formulas know the states, the inputs, t, the efforts and the parameters.
        """

        def values(parts: Expressions) -> ca.SX:
            known = {**parts.known, **parts.values}
            return ca.vertcat(*(ca.SX(evaluate(text, known)) for text in formulas))

        return self._made("formulas", values, *formulas)

    def _made(
        self, name: str, value: Callable[[Expressions], ca.SX], *key: str
    ) -> ca.Function:
        return self.built((name, *key), lambda: function_of(self, name, value))


def _split_structure(S: Any, states: Sequence[str]) -> tuple[Any, dict[str, Terms]]:
    """The numbers of a mapping of entries as a matrix; its terms along directions.

    Raises:
        ModelError: a key is no pair of two states, or an entry is given twice.
    """
    if not isinstance(S, Mapping):
        return S, {}
    names = list(states)
    matrix = np.zeros((len(names), len(names)))
    exchanges: dict[str, Terms] = {}
    known: set[frozenset[str]] = set()
    for pair, entry in S.items():
        is_pair = isinstance(pair, tuple) and len(set(pair) & set(names)) == 2 == len(
            pair
        )
        if not is_pair or frozenset(pair) in known:
            raise ModelError(
                f"S has an entry for {shown(pair)}; expected pairs of two states "
                f"({', '.join(names)}), each once: S[j, i] = -S[i, j] by itself."
            )
        known.add(frozenset(pair))
        row, column = pair
        if isinstance(entry, Dictionary | str):
            exchanges[f"dH_d{column}*{row} - dH_d{row}*{column}"] = entry
            continue
        require(is_of(entry, float), f"S[{pair!r}]", entry, "a number or terms")
        matrix[names.index(row), names.index(column)] = entry
        matrix[names.index(column), names.index(row)] = -entry
    return matrix, exchanges


@dataclass(frozen=True, kw_only=True, init=False, repr=False)
class PseudoHamiltonian(Model):
    """A model with an energy H.

    Its equations are (thesis Eq. 2.42)::

        dx/dt = (S - R(x)) grad H(x) + F(x, t, u)

    S is skew-symmetric, R is symmetric: a sum of r(x) b b', where the direction b is a
    state or a sum of states.

    Args:
        states: names of the states.
        S: (n_states, n_states) matrix, see `canonical`; or the entries above or below
            the diagonal, ``{("q", "p"): 1, ("p1", "p2"): "g*B"}``, a number or terms
            each. Terms exchange energy without loss, whatever they are: they stand in
            F, along ``"dH_dp2*p1 - dH_dp1*p2"``, and are called S_p1_p2.
        H: dictionary of terms in the states.
        R: per equation, the terms of the diagonal entry R_ii(x) >= 0; the loss is
            R_ii dH/dx_i. Or along a direction: ``R={"p1 - p2": "d"}`` is a damper
            between two bodies, with the force d (dH/dp1 - dH/dp2) on both.
        F: per equation, terms in the states, inputs, efforts (``dH_dp``) and the time
            ``t``. Or along a direction: what ``"h2 - h1"`` takes from h1 h2 gets, and
            of ``"h2 - s*h1"`` the share s is a parameter.
        inputs: names of the measured inputs.
        sensor: per measured state, the error that its sensor adds, such as an offset;
            terms as in F.
        memory: the states that are the memory of an effect.
        kind: what the states are: ``"mechanical"``, ``"hydraulic"``, ``"electrical"``
            or ``"thermal"``; or by state, such as ``{"T1": "thermal"}``. It decides
            which effects `catalogue` offers, and their names. Positions and momenta are
            mechanical by default.

    Raises:
        ModelError: unknown names, a matrix that is not skew-symmetric, a term that
            occurs twice, or an unknown kind.

    Examples:
        >>> spring = ph.PseudoHamiltonian(
        ...     states=["q", "p"],
        ...     S=ph.canonical(1),
        ...     H=ph.formula("k*q**2/2 + p**2/(2*m)", k=ph.Parameter(10.0), m=2.5),
        ...     R=ph.damping("p"),
        ... )
        >>> spring.free
        ('k', 'R_p')

        The same as texts, with m unknown, too:

        >>> spring = ph.PseudoHamiltonian(
        ...     states=["q", "p"],
        ...     S=ph.canonical(1),
        ...     H="k*q**2/2 + p**2/(2*m)",
        ...     R={"p": "c"},
        ... )
        >>> spring.free
        ('k', 'm', 'c')
    """

    def __post_init__(self) -> None:
        if self.S is None:
            raise ModelError(
                "S is missing; give canonical(n) for n positions and n momenta, "
                "or a matrix."
            )
        super().__post_init__()
        if not self.H.terms:
            raise ModelError(
                "H has no term, so the model has no energy; give it a formula or "
                "dictionary, or use FirstOrder."
            )


@dataclass(frozen=True, kw_only=True, init=False, repr=False)
class FirstOrder(Model):
    """A model without an energy and its structure (the thesis' BSI).

    Its equations are::

        dx_i/dt = F_i(x, t, u) - R_ii(x) x_i

    Its efforts are the states. R and F may have directions, too.

    Args:
        states: names of the states.
        F: per equation, terms in the states, inputs and the time ``t``.
        inputs: names of the measured inputs.
        R: per equation, the terms of R_ii(x) >= 0.
        sensor: per measured state, the error that its sensor adds.
        memory: the states that are the memory of an effect.
        kind: what the states are, as in `PseudoHamiltonian`.
        S: must be empty; it is an argument because `dataclasses.replace` passes all
            fields.
        H: must be empty, as S.

    Raises:
        ModelError: unknown names, a term that occurs twice, an S or an H, or an unknown
            kind.

    Examples:
        >>> ph.FirstOrder(["h"], {"h": "u - a*sqrt(h)"}, inputs=["u"]).free
        ('a',)
    """

    has_energy: ClassVar[bool] = False

    @typed
    def __init__(
        self,
        states: Sequence[str],
        F: TermsByState,
        inputs: Sequence[str] = (),
        R: TermsByState | None = None,
        sensor: TermsByState | None = None,
        *,
        memory: Sequence[str] = (),
        kind: str | Mapping[str, str] | None = None,
        S: Any = None,
        H: Terms | None = None,
    ) -> None:
        if H or np.any(checked_structure(S, len(states))):
            raise ModelError(
                "a FirstOrder model has no S and no H; "
                "use PseudoHamiltonian, or put the terms into F."
            )
        others: dict[str, Any] = {"R": R, "sensor": sensor, "kind": kind}
        super().__init__(states=states, F=F, inputs=inputs, memory=memory, **others)

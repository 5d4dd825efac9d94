"""What the exchange S(x) conserves: the Jacobi identity and Casimir functions.

Where S satisfies the Jacobi identity, it belongs to Poisson brackets, and coordinates
exist in which it is canonical (Darboux). A Casimir C has S grad C = 0: no energy moves
it, only losses and outside forces do (van der Schaft and Jeltsema, Port-Hamiltonian
Systems Theory, Foundations and Trends in Systems and Control 1, 2014, section 2).
"""

from collections.abc import Sequence
from contextlib import suppress
from itertools import combinations_with_replacement
from math import prod

import casadi as ca
import numpy as np

from phsi_opt.arguments import require, require_count, typed
from phsi_opt.errors import ModelError
from phsi_opt.model.base import BaseModel
from phsi_opt.model.expressions import names_of
from phsi_opt.model.slots import EXCHANGE, PlacedTerm

ROUNDING = 1e-9  # relative, up to which identities hold


@typed
def is_poisson(model: BaseModel) -> bool:
    """Whether S(x) satisfies the Jacobi identity, at the model's values.

    It is checked at random states; a matrix of numbers always does::

        sum_l S_il dS_jk/dx_l + S_jl dS_ki/dx_l + S_kl dS_ij/dx_l = 0

    Args:
        model: with an energy, and with values for the parameters of S.

    Raises:
        ModelError: there is no S, it is no function of the states alone, or it has no
            finite value.

    Examples:
        >>> S = {("x", "y"): "-z", ("x", "z"): "y", ("y", "z"): "-x"}
        >>> H = "x**2/2 + y**2/4 + z**2/6"
        >>> body = ph.PseudoHamiltonian(states=["x", "y", "z"], S=S, H=H)
        >>> ph.is_poisson(body)
        True
        >>> ph.casimirs(body)
        ['x**2 + y**2 + z**2']
    """
    x, S = _structure(model)
    n = S.shape[0]
    points = _points(x, S)
    function = ca.Function("both", [x], [S, ca.jacobian(ca.vec(S), x)])
    for point in points:
        values, moved = map(np.array, function(point))
        # By rows i and pairs (j, k): S is stacked by columns, (k, j) is skew to (j, k).
        along = np.einsum("il,kjl->ijk", values, moved.reshape(n, n, n))
        cyclic = along + along.transpose(1, 2, 0) + along.transpose(2, 0, 1)
        if np.abs(cyclic).max() > ROUNDING * np.abs(along).max():
            return False
    return True


@typed
def casimirs(model: BaseModel, degree: int = 2) -> list[str]:
    """Polynomials in the states that S conserves whatever the energy, as formulas.

    Those of the lowest degree that has any; sums and products of them are others, and
    there may be further ones of a higher degree.

    Args:
        model: with an energy, and with values for the parameters of S.
        degree: of the polynomials, at most; 4 or less.

    Raises:
        ModelError: as of `is_poisson`; or the degree is too high.

    Examples:
        >>> S = {("x", "y"): 1.0, ("y", "z"): 2.0}
        >>> H = "x**2 + y**2 + z**2"
        >>> tanks = ph.PseudoHamiltonian(states=["x", "y", "z"], S=S, H=H)
        >>> ph.casimirs(tanks)
        ['x + 0.5*z']
    """
    require_count("degree", degree)
    require(degree <= 4, "degree", degree, "4 or less")
    x, S = _structure(model)
    factors: list[tuple[int, ...]] = []
    for power in range(1, degree + 1):
        factors += combinations_with_replacement(range(S.shape[0]), power)
        products = [prod(x[k] for k in places) for places in factors]
        moved = ca.mtimes(S, ca.jacobian(ca.vertcat(*products), x).T)
        function = ca.Function("moved", [x], [moved])
        points = _points(x, S, len(factors))
        rows = np.vstack([np.array(function(point)) for point in points])
        _, sizes, directions = np.linalg.svd(rows, full_matrices=False)
        weights = _reduced(directions[sizes <= ROUNDING * sizes.max()])
        if len(weights):
            names = [_product([model.states[k] for k in one]) for one in factors]
            return [_sum(one, names) for one in weights]
    return []


def structure_words(model: BaseModel) -> str:
    """What S(x) is, in a line; "" where it has no terms, or not all their values.

    Nor is anything told of an S that is no function of the states alone, or is nowhere
    finite.
    """
    terms = _entries(model)
    names = {name for placed in terms for name in names_of(placed.term.body)}
    names |= {one.name for placed in terms for one in placed.entries()}
    parameters = [
        model.entries[name].parameter for name in names & model.entries.keys()
    ]
    if not terms or not all(one.fixed for one in parameters):
        return ""
    with suppress(ModelError):
        holds = "holds" if is_poisson(model) else "does not hold"
        conserved = (
            casimirs(model) if model.n_states <= 12 else []
        )  # else it takes long
        told = f"; S(x) conserves {', '.join(conserved)}" if conserved else ""
        return f"S(x): the Jacobi identity {holds}{told}"
    return ""


def _entries(model: BaseModel) -> list[PlacedTerm]:
    """The terms of S."""
    placed = filter(lambda one: one.slot == "F", model.placed())
    return [one for one in placed if EXCHANGE.fullmatch(one.equation)]


def _structure(model: BaseModel) -> tuple[ca.SX, ca.SX]:
    """Symbols of the states, less the memory of effects, and S of them.

    Raises:
        ModelError: there is no S, or it is no function of the states alone.
    """
    if not model.has_energy:
        raise ModelError("a model without an energy has no S, so it conserves nothing.")
    n = model.n_states - len(model.memory)
    states = model.states[:n]
    x = ca.SX.sym("x", n)
    names = {**model.values, **dict(zip(states, ca.vertsplit(x), strict=True))}
    S = ca.SX(ca.DM(np.array(model.S, dtype=float)[:n, :n]))
    for placed in _entries(model):
        others = names_of(placed.term.body) - names.keys() - placed.term.inner.keys()
        if others:
            raise ModelError(
                f"{placed.place} contains {', '.join(sorted(others))}; expected a "
                "function of the states alone, for the identities of S(x)."
            )
        exchange = EXCHANGE.fullmatch(placed.equation)
        assert exchange is not None
        row, column = states.index(exchange[2]), states.index(exchange[1])
        S[row, column] += placed.value(names)
        S[column, row] -= placed.value(names)
    return x, S


def _points(x: ca.SX, S: ca.SX, n_more: int = 0) -> np.ndarray:
    """Random states (40 + n_more, n_states) at which S is finite.

    Raises:
        ModelError: it is nowhere.
    """
    n = 40 + n_more
    points = np.random.default_rng(0).uniform(0.3, 2.0, (2 * n, S.shape[0]))
    signs = np.random.default_rng(1).choice([-1.0, 1.0], points.shape)
    function = ca.Function("S", [x], [S])
    tried = np.concatenate([points, signs * points])
    is_finite = [np.isfinite(np.array(function(point))).all() for point in tried]
    if not any(is_finite):
        raise ModelError("S(x) has no finite value; check its formulas.")
    # Of either sign where it may have one.
    found = tried[np.array(is_finite)]
    return found[np.linspace(0, len(found) - 1, n).astype(int)]


def _product(names: Sequence[str]) -> str:
    powers = {name: names.count(name) for name in names}
    return "*".join(one if k == 1 else f"{one}**{k}" for one, k in powers.items())


def _sum(weights: np.ndarray, texts: Sequence[str]) -> str:
    """A weighted sum as a formula."""
    terms = []
    for weight, text in zip(weights.tolist(), texts, strict=True):
        if abs(weight) > ROUNDING:
            is_one = abs(weight - 1) < ROUNDING
            terms.append(text if is_one else f"{weight:.10g}*{text}")
    return " + ".join(terms).replace("+ -", "- ")


def _reduced(rows: np.ndarray) -> np.ndarray:
    """Rows of the same span in reduced echelon form."""
    rows = rows.copy()
    done = 0
    for column in range(rows.shape[1]):
        if done == len(rows):
            break
        pivot = done + int(np.argmax(np.abs(rows[done:, column])))
        if abs(rows[pivot, column]) < 1e-6:
            continue  # no Casimir begins with this product
        rows[[done, pivot]] = rows[[pivot, done]]
        rows[done] /= rows[done, column]
        others = np.arange(len(rows)) != done
        rows[others] -= np.outer(rows[others, column], rows[done])
        done += 1
    return rows[:done]

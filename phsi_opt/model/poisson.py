"""What the exchange S(x) conserves: the Jacobi identity and Casimir functions.

Where S satisfies the Jacobi identity, it belongs to Poisson brackets, and coordinates
exist in which it is canonical (Darboux). A Casimir C has S grad C = 0: no energy moves
it, only losses and outside forces do (van der Schaft and Jeltsema, Port-Hamiltonian
Systems Theory, Foundations and Trends in Systems and Control 1, 2014, section 2).
"""

from itertools import combinations_with_replacement
from math import prod

import casadi as ca
import numpy as np

from phsi_opt.arguments import require_count, typed
from phsi_opt.model.base import BaseModel
from phsi_opt.model.slots import EXCHANGE

N_POINTS = 40  # random states at which identities are checked
ROUNDING = 1e-9  # relative, up to which they hold
PIVOT = 1e-6  # least weight of a product that a Casimir begins with


def structure_function(model: BaseModel) -> ca.Function:
    """CasADi function x -> S(x), at the model's values."""
    x = ca.SX.sym("x", model.n_states)
    names = {**model.values, **dict(zip(model.states, ca.vertsplit(x), strict=True))}
    found = ca.SX(ca.DM(np.array(model.S, dtype=float)))
    for placed in model.placed():
        exchange = EXCHANGE.fullmatch(placed.equation)
        if placed.slot == "F" and exchange:
            row, column = model.index(exchange[2]), model.index(exchange[1])
            found[row, column] += placed.value(names)
            found[column, row] -= placed.value(names)
    return ca.Function("S", [x], [found])


@typed
def is_poisson(model: BaseModel) -> bool:
    """Whether S(x) satisfies the Jacobi identity, at the model's values.

    It is checked at random states; a matrix of numbers always does::

        sum_l S_il dS_jk/dx_l + S_jl dS_ki/dx_l + S_kl dS_ij/dx_l = 0

    Args:
        model: with values for the parameters of S.

    Examples:
        >>> S = {("x", "y"): "-z", ("x", "z"): "y", ("y", "z"): "-x"}
        >>> H = "x**2/2 + y**2/4 + z**2/6"
        >>> body = ph.PseudoHamiltonian(states=["x", "y", "z"], S=S, H=H)
        >>> ph.is_poisson(body)
        True
        >>> ph.casimirs(body)
        ['x**2 + y**2 + z**2']
    """
    structure = structure_function(model)
    n = model.n_states
    x = ca.SX.sym("x", n)
    S = structure(x)
    slopes = ca.jacobian(ca.vec(S), x)
    function = ca.Function("both", [x], [S, slopes])
    for point in _points(n):
        values, moved = map(np.array, function(point))
        # By rows i and pairs (j, k): S is stacked by columns, (k, j) is skew to (j, k).
        along = np.einsum("il,kjl->ijk", values, moved.reshape(n, n, n))
        cyclic = along + along.transpose(1, 2, 0) + along.transpose(2, 0, 1)
        if np.abs(cyclic).max() > ROUNDING * max(np.abs(along).max(), 1.0):
            return False
    return True


@typed
def casimirs(model: BaseModel, degree: int = 2) -> list[str]:
    """Polynomials in the states that S conserves whatever the energy, as formulas.

    Those of the lowest degree that has any: sums and products of them are others.

    Args:
        model: with values for the parameters of S.
        degree: of the polynomials, at most.

    Examples:
        >>> S = {("x", "y"): 1.0, ("y", "z"): 2.0}
        >>> H = "x**2 + y**2 + z**2"
        >>> tanks = ph.PseudoHamiltonian(states=["x", "y", "z"], S=S, H=H)
        >>> ph.casimirs(tanks)
        ['x + 0.5*z']
    """
    require_count("degree", degree)
    x = ca.SX.sym("x", model.n_states)
    structure = structure_function(model)(x)
    for power in range(1, degree + 1):
        factors = list(combinations_with_replacement(range(model.n_states), power))
        products = [prod(x[k] for k in places) for places in factors]
        slopes = ca.jacobian(ca.vertcat(*products), x)
        moved = ca.Function("moved", [x], [ca.mtimes(structure, slopes.T)])
        points = _points(model.n_states)
        rows = np.vstack([np.array(moved(point)) for point in points])
        _, sizes, directions = np.linalg.svd(rows, full_matrices=False)
        weights = _reduced(directions[sizes <= ROUNDING * max(sizes.max(), 1.0)])
        if len(weights):
            texts = [_product([model.states[k] for k in one]) for one in factors]
            return [_sum(one, texts) for one in weights]
    return []


def _sum(weights: np.ndarray, texts: list[str]) -> str:
    """A weighted sum as a formula."""
    terms = []
    for weight, text in zip(weights.tolist(), texts, strict=True):
        if abs(weight) > ROUNDING:
            is_one = abs(weight - 1) < ROUNDING
            terms.append(text if is_one else f"{weight:.6g}*{text}")
    return " + ".join(terms).replace("+ -", "- ")


def structure_words(model: BaseModel) -> str:
    """What S(x) is, in a line; "" where it has no terms, or not all their values."""
    entries = list(filter(EXCHANGE.fullmatch, model.F))
    known = [
        one.parameter.value for one in model.entries.values() if one.equation in entries
    ]
    if not entries or None in known:
        return ""
    holds = "holds" if is_poisson(model) else "does not hold"
    conserved = casimirs(model)
    told = f"; S(x) conserves {', '.join(conserved)}" if conserved else ""
    return f"S(x): the Jacobi identity {holds}{told}"


def _points(n: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(0.3, 2.0, (N_POINTS, n))


def _product(names: list[str]) -> str:
    powers = {name: names.count(name) for name in names}
    return "*".join(one if k == 1 else f"{one}**{k}" for one, k in powers.items())


def _reduced(rows: np.ndarray) -> np.ndarray:
    """Rows of the same span in reduced echelon form."""
    rows = rows.copy()
    done = 0
    for column in range(rows.shape[1]):
        if done == len(rows):
            break
        pivot = done + int(np.argmax(np.abs(rows[done:, column])))
        if abs(rows[pivot, column]) < PIVOT:
            continue
        rows[[done, pivot]] = rows[[pivot, done]]
        rows[done] /= rows[done, column]
        others = np.arange(len(rows)) != done
        rows[others] -= np.outer(rows[others, column], rows[done])
        done += 1
    return rows[:done]

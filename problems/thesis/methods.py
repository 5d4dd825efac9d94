"""Every method of the thesis on one system, through one interface: (system, data, kind,
seed) -> a result.

A result has `simulate`, `equations`, `parameters`, `seconds` and `loss_value`. ``kind``
is "clean" or "noisy": the thesis trains with other settings on clean data. Pysindy is
imported where it is used.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

import phsi_opt as ph
from phsi_opt.baselines.gradient_descent import Descent, gradient_descent
from phsi_opt.model.terms import Dictionary, Term
from problems.thesis.scores import phsi_loss
from problems.thesis.systems import (
    System,
    known_leak,
    mass_spring_descent_model,
    tank_model,
)

SIGNIFICANCE = 0.01
LASSO_WEIGHTS = 10.0 ** np.arange(-9, 0)  # per sample
WRONG_FREQUENCY = 1.0  # what regressions get that cannot learn one
KNOTS = 12  # of the hinges that stand for a network
DECIMALS = 6  # of places and widths in the texts of hinges
DEPENDENT = 1e-10  # share of the largest singular value below which hinges are the same
# Names of the settings of a baseline: appendix B as printed, or tuned on
# System.data(seed=101), a draw that appears in no table.
THESIS = "thesis"
TUNED = "tuned"
Method = Callable[[System, ph.Measurements, str, int], Any]


def solver(
    system: System,
    data: ph.Measurements,
    kind: str = "noisy",
    seed: int = 0,
    significance: float | None = SIGNIFICANCE,
) -> Any:
    """PHSI by the solver: L1, pruning by size and significance; tanks with a neural
    force of the level of tank 4.
    """
    pruning = ph.Pruning(system.threshold, significance=significance)
    return by_solver(system, data, pruning, seed)


# With the plain threshold of the thesis.
solver_threshold: Method = partial(solver, significance=None)


def by_solver(
    system: System,
    data: ph.Measurements,
    pruning: ph.Pruning | None,
    seed: int = 0,
    l1: dict[str, float] | None = None,
) -> Any:
    """PHSI by the solver with given pruning and L1 (None: the system's)."""
    weights = dict(system.l1) if l1 is None else l1
    if system.name != "tanks":
        return ph.identify(system.model(), data, ph.PHSILoss(), weights, pruning)
    from phsi_opt.learning.hybrid import hybrid
    from phsi_opt.learning.hybrid_network import NeuralForce

    force = NeuralForce(("mu4",), ("mu4",))
    return hybrid(system.model(), data, force, weights, pruning, seed=seed)


def likelihood(system: System, data: ph.Measurements, start: Any) -> ph.Fit:
    """Maximum likelihood on the support that `solver` found; the network of the tanks
    as a dictionary of hinges.
    """
    model = start.model
    if system.name == "tanks":
        model = replace(model, F=hinges(start, data))
    return ph.identify(model, data)


def hinges(hybrid: Any, data: ph.Measurements) -> dict[str, Dictionary]:
    """The force of a hybrid's network of one state as smooth hinges, by equation; then
    all is one program, which maximum likelihood can solve.

    Fitted to the network where the data have been. With knots v_k at quantiles of the
    visited values, w half their median distance, and coefficients by least squares::

        F(v) = c + a v + sum_k b_k sqrt((v - v_k)^2 + w^2)
    """
    (name,) = hybrid.force.variables
    x = np.concatenate([run.x for run in data.trajectories])
    x = x[np.isfinite(x).all(axis=1)]
    visited = x[:, hybrid.model.states.index(name)]
    places = np.quantile(visited, np.linspace(0.0, 1.0, KNOTS + 2)[1:-1])
    places = np.unique(np.round(places, DECIMALS))
    width = round(float(np.median(np.diff(places))) / 2, DECIMALS)
    bodies = ["1", name]
    columns = [np.ones_like(visited), visited]
    for place in places.tolist():
        bodies.append(f"sqrt(({name} - {place!r})**2 + {width!r}**2)")
        columns.append(np.sqrt((visited - place) ** 2 + width**2))
    terms = np.column_stack(columns)
    scale = np.sqrt(np.mean(terms**2, axis=0))
    found = np.linalg.lstsq(terms / scale, hybrid.force(x), rcond=DEPENDENT)[0]
    dictionaries = {}
    for equation, sizes in zip(hybrid.force.equations, found.T, strict=True):
        pairs = zip(bodies, (sizes / scale).tolist(), strict=True)
        summands = [Term(body, ph.Parameter(size)) for body, size in pairs]
        dictionaries[equation] = Dictionary(tuple(summands))
    return dictionaries


def descent(
    system: System,
    data: ph.Measurements,
    kind: str = "noisy",
    seed: int = 0,
    start: str = "thesis",
    settings: str = TUNED,
) -> Any:
    """PHSI by gradient descent: Algorithm 6 of the thesis, which prunes by size.

    ``start`` is "thesis" or "normal".
    """
    chosen = replace(descent_settings(system, kind, settings), start=start)
    return gradient_descent(descent_model(system), data, chosen, seed)


def descent_model(system: System) -> ph.PseudoHamiltonian:
    """The model that gradient descent begins with; of the tanks with the known form of
    the leak, in place of the network that the thesis trains.
    """
    if system.name == "mass_spring":
        return mass_spring_descent_model()
    return tank_model(known_leak()) if system.name == "tanks" else system.model()


def descent_settings(system: System, kind: str, settings: str) -> Descent:
    """Settings of the descent on clean or noisy data."""
    if settings == THESIS:
        return system.descent_thesis
    return system.descent if kind == "clean" else system.descent_noisy


def bsi_solver(
    system: System, data: ph.Measurements, kind: str = "noisy", seed: int = 0
) -> Any:
    """The dictionary of right-hand sides (BSI) by the solver."""
    l1 = {"F": system.l1["F"]} if "F" in system.l1 else None
    pruning = ph.Pruning(system.threshold, significance=SIGNIFICANCE)
    return ph.identify(system.first_order(), data, ph.PHSILoss(), l1, pruning)


def bsi_descent(
    system: System,
    data: ph.Measurements,
    kind: str = "noisy",
    seed: int = 0,
) -> Any:
    """The dictionary of right-hand sides (BSI) by gradient descent.

    Without L1: appendix B has it for PHSI alone, and BSI has no H to weigh.
    """
    chosen = replace(descent_settings(system, kind, TUNED), l1={})
    return gradient_descent(system.first_order(), data, chosen, seed)


def sindy(
    system: System, data: ph.Measurements, kind: str, seed: int, *, optimizer: str
) -> Any:
    """SINDy by pysindy: "stlsq" or "sr3"."""
    from problems.peers.sindy import sindy as by_sindy

    large = optimizer == "sr3" and system.name in ("henon_heiles", "schrodinger")
    threshold, ridge = 0.5 if large else 0.05, 1e-10
    fixed = _frequencies(system)
    return by_sindy(
        system.first_order(), data, optimizer, threshold, ridge, fixed=fixed
    )


stlsq: Method = partial(sindy, optimizer="stlsq")
sr3: Method = partial(sindy, optimizer="sr3")


def lasso(
    system: System, data: ph.Measurements, kind: str = "noisy", seed: int = 0
) -> Any:
    """The LASSO of thesis Eq. 4.8, by CVXPY; its weight is the one that predicts a
    fifth of the trajectories best.
    """
    from problems.peers.sindy import lasso as by_lasso

    began = time.perf_counter()
    model, fixed = system.first_order(), _frequencies(system)
    train, test = data.split(0.8)

    def fitted(weight: float, of: ph.Measurements) -> Any:
        return by_lasso(model, of, weight * of.n_samples, fixed=fixed)

    def held_out_loss(weight: float) -> float:
        try:
            return phsi_loss(fitted(weight, train), test)
        except ph.ModelError:  # the weight leaves no term
            return np.inf

    found = fitted(min(LASSO_WEIGHTS, key=held_out_loss), data)
    return replace(found, seconds=time.perf_counter() - began)


def _frequencies(system: System) -> dict[str, float] | None:
    """SINDy cannot learn a frequency (thesis Section 6.3), so it gets a wrong one."""
    if system.name != "mass_spring":
        return None
    return {"F_p.omega_t": WRONG_FREQUENCY}

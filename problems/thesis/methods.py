"""Every method of the thesis on one system, through one interface: (system, data, kind,
seed) -> a result.

A result has `simulate`, `equations`, `parameters`, `seconds` and `loss_value`. ``kind``
is "clean" or "noisy": the thesis trains with other settings on clean data. Torch and
pysindy are imported where they are used.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

import phsi_opt as ph
from problems.thesis.hinges import hinges
from problems.thesis.scores import phsi_loss
from problems.thesis.systems import (
    FLOWS,
    System,
    mass_spring_descent_model,
    tank_structure,
)

SIGNIFICANCE = 0.01
LASSO_WEIGHTS = 10.0 ** np.arange(-9, 0)  # per sample
WRONG_FREQUENCY = 1.0  # what regressions get that cannot learn one
# Names of the settings of a baseline: appendix B as printed, or tuned on
# System.data(seed=101), a draw that appears in no table.
THESIS = "thesis"
TUNED = "tuned"
PHNN_SETTINGS: dict[str, dict[str, Any]] = {
    THESIS: {
        "learning_rate": 3e-3,
        "epochs": 150,
        "penalty": 0.1,
        "weight_decay": 1e-4,
    },
    TUNED: {"learning_rate": 1e-3, "epochs": 150, "penalty": 0.1},
}
Method = Callable[[System, ph.Measurements, str, int], Any]


def solver(
    system: System, data: ph.Measurements, kind: str = "noisy", seed: int = 0
) -> Any:
    """PHSI by the solver: L1, pruning by size and significance; tanks with a neural
    force of the level of tank 4.
    """
    return by_solver(
        system, data, ph.Pruning(system.threshold, significance=SIGNIFICANCE), seed
    )


def solver_threshold(
    system: System, data: ph.Measurements, kind: str = "noisy", seed: int = 0
) -> Any:
    """PHSI by the solver with the plain threshold of the thesis."""
    return by_solver(system, data, ph.Pruning(system.threshold), seed)


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

    return hybrid(
        system.model(),
        data,
        NeuralForce(("mu4",), ("mu4",)),
        weights,
        pruning,
        seed=seed,
    )


def likelihood(system: System, data: ph.Measurements, start: Any) -> ph.Fit:
    """Maximum likelihood on the support that `solver` found; the network of the tanks
    as a dictionary of hinges.
    """
    model = start.model
    if system.name == "tanks":
        model = replace(model, F=hinges(start, data))
    return ph.identify(model, data)


def descent(
    system: System,
    data: ph.Measurements,
    kind: str = "noisy",
    seed: int = 0,
    start: str = "thesis",
    settings: str = TUNED,
    significance: float | None = None,
) -> Any:
    """PHSI by gradient descent: Algorithm 6 of the thesis.

    Args:
        system: what is identified.
        data: of the system.
        kind: "clean" or "noisy".
        seed: of batches and random starts.
        start: "thesis" or "normal".
        settings: `TUNED` or `THESIS`.
        significance: of the pruning; None: the thesis' rule, size alone.
    """
    from problems.thesis.joint_descent import joint_descent

    chosen, force = descent_settings(system, kind, start, settings)
    model = (
        mass_spring_descent_model() if system.name == "mass_spring" else system.model()
    )
    return joint_descent(model, data, chosen, seed, force, significance)


def descent_settings(
    system: System,
    kind: str,
    start: str = "thesis",
    settings: str = TUNED,
) -> tuple[Any, Any]:
    """Settings of the descent, and the force beside it."""
    chosen = system.descent if kind == "clean" else system.descent_noisy
    if settings == THESIS:
        chosen = system.descent_thesis
    return chosen.settings(start)


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
    settings: str = TUNED,
) -> Any:
    """The dictionary of right-hand sides (BSI) by gradient descent.

    Without L1: appendix B has it for PHSI alone, and BSI has no H to weigh.
    """
    from phsi_opt.baselines.gradient_descent import gradient_descent

    chosen = descent_settings(system, kind, settings=settings)[0]
    return gradient_descent(system.first_order(), data, replace(chosen, l1={}), seed)


def stlsq(
    system: System, data: ph.Measurements, kind: str = "noisy", seed: int = 0
) -> Any:
    """SINDy by sequentially thresholded least squares (pysindy)."""
    from problems.peers.sindy import sindy

    return sindy(
        system.first_order(), data, "stlsq", 0.05, 1e-10, fixed=_frequencies(system)
    )


def sr3(
    system: System, data: ph.Measurements, kind: str = "noisy", seed: int = 0
) -> Any:
    """SINDy by SR3 (pysindy)."""
    from problems.peers.sindy import sindy

    threshold = {"henon_heiles": 0.5, "schrodinger": 0.5}.get(system.name, 0.05)
    return sindy(
        system.first_order(), data, "sr3", threshold, fixed=_frequencies(system)
    )


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

    def left_out(weight: float) -> float:
        try:
            return phsi_loss(
                by_lasso(model, train, weight * train.n_samples, fixed=fixed), test
            )
        except ph.ModelError:  # the weight leaves no term
            return np.inf

    found = by_lasso(
        model, data, min(LASSO_WEIGHTS, key=left_out) * data.n_samples, fixed=fixed
    )
    return replace(found, seconds=time.perf_counter() - began)


def ssinn(
    system: System, data: ph.Measurements, kind: str = "noisy", seed: int = 0
) -> Any:
    """Separable Hamiltonian, symplectic steps, gradient descent; only for a system
    whose energy is T(p) + V(q).
    """
    from problems.peers.ssinn import ssinn as by_ssinn

    return by_ssinn(data, ["q1", "q2"], ["p1", "p2"], 3, seed=seed)


def phnn(
    system: System,
    data: ph.Measurements,
    kind: str = "noisy",
    seed: int = 0,
    settings: str = THESIS,
    epochs: int | None = None,
) -> Any:
    """Pseudo-Hamiltonian neural network: H (and F) are networks.

    The thesis trains it on the mass-spring alone (appendix B.3); the others get the
    same settings. Its loss is a mean over the states, the one here a sum: penalty and
    weight decay are multiplied by their number. ``epochs``: fewer of them, for a quick
    run.
    """
    from problems.peers.phnn import NetworkDescent
    from problems.peers.phnn import phnn as by_phnn

    S = (
        tank_structure()
        if system.name == "tanks"
        else ph.canonical(len(system.states) // 2)
    )
    damping = {"mass_spring": ["p"], "tanks": list(FLOWS)}.get(system.name, [])
    force = {"mass_spring": (["p"], ["t"]), "tanks": (["mu4"], ["mu4"])}.get(
        system.name
    )
    chosen = NetworkDescent(**PHNN_SETTINGS[settings])
    n_states = len(system.states)
    chosen = replace(
        chosen,
        penalty=chosen.penalty * n_states,
        weight_decay=chosen.weight_decay * n_states,
    )
    if epochs is not None:
        chosen = replace(chosen, epochs=epochs)
    return by_phnn(data, S, chosen, damping, force, seed)


def _frequencies(system: System) -> dict[str, float] | None:
    """SINDy cannot learn a frequency (thesis Section 6.3), so it gets a wrong one."""
    if system.name != "mass_spring":
        return None
    return {"F_p.omega_t": WRONG_FREQUENCY}

"""What a missing force does with energy: takes it out, conserves it, follows an input,
or depends on time.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pandas as pd

from phsi_opt.criteria import CLEAR_PATTERN, NAMED_CAUSE, SECOND_CAUSE, TIED_CAUSES
from phsi_opt.force_analysis.dependence import (
    N_KNOTS,
    dependence,
    folds,
    hats,
    leading,
    left_out,
    left_out_of_time,
    of_time,
    pair_of,
    share_of,
    wave_of,
)
from phsi_opt.force_analysis.force_record import ForceRecord, spaced
from phsi_opt.model.model import FirstOrder, Model
from phsi_opt.model.structure import position_rows
from phsi_opt.statistics import TINY


@dataclass(frozen=True, eq=False)
class Power:
    """What the missing force does with energy, as `power` found; ``sentences`` has one
    per equation.

    ``table`` has a row per equation: equation, mean_power (force times effort, averaged
    over the time; negative: taken out), parameters, constant, dissipated, conserved,
    inputs, time and unexplained. These shares are parts of the force's mean square on
    stretches of time left out, each what its cause adds to the stronger ones; they sum
    to one.
    """

    table: pd.DataFrame
    sentences: tuple[str, ...]


CAUSES = (
    "constant",
    "dissipated",
    "conserved",
    "inputs",
    "time",
)  # of two that are alike, the first is named
SHARES = ("parameters", *CAUSES)


def power(path: ForceRecord) -> Power:
    """Whether the missing force w_i dissipates power w_i dH/dx_i, conserves it, or
    depends on inputs or the time.

    The force is explained by functions of five kinds: a constant; odd functions of its
    own effort dH/dx_i (dissipated); functions of the states that it exchanges energy
    with, the positions for a momentum (conserved: what goes in comes back on the same
    way); functions of the inputs; functions of the time. The model's own parameters
    move along. The kind that predicts the left-out stretches best comes first; others
    follow while they add a fifth.
    """
    rows, said = [], []
    for name in path.equations:
        causes = _Causes.of(path, name)
        shares = causes.in_turn()
        mean_power = float(
            np.sum(path.force_on(name) * path.effort_of(name) * path.h) / np.sum(path.h)
        )
        each = [shares.get(kind, 0.0) for kind in SHARES]
        rows.append((name, mean_power, *each, 1 - sum(each)))
        said.append(causes.sentence(shares))
    return Power(
        pd.DataFrame(rows, columns=["equation", "mean_power", *SHARES, "unexplained"]),
        tuple(said),
    )


@dataclass(frozen=True, eq=False)
class _Causes:
    """Functions of every kind that may explain the force of one equation, and what each
    explains alone.
    """

    path: ForceRecord
    equation: str
    fold: np.ndarray
    columns: Mapping[str, np.ndarray]

    @classmethod
    def of(cls, path: ForceRecord, equation: str) -> "_Causes":
        bases = {
            "constant": np.ones((len(path.t), 1)),
            "dissipated": _odd(path.effort_of(equation)),
        }
        if partners := _partners(path, equation):
            bases["conserved"] = _sum_of(path, partners)
        if path.inputs.shape[1]:
            bases["inputs"] = _sum_of(path, path.fit.model.inputs)
        columns = {
            kind: path.as_estimated(equation, base) for kind, base in bases.items()
        }
        columns["parameters"] = path.by_parameters(equation)
        return cls(path, equation, folds(path.run), columns)

    def share(self, kinds: Sequence[str]) -> float:
        """Part of the force's mean square that functions of these kinds predict
        together on stretches left out.
        """
        w, fixed = (
            self.path.force_on(self.equation),
            [self.columns[kind] for kind in kinds if kind != "time"],
        )
        timed = "time" in kinds
        error = (
            left_out_of_time(self.path, fixed, w, self.fold)
            if timed
            else left_out(fixed, w, self.fold)
        )
        return share_of(error, float(np.sum(w**2)))

    @cached_property
    def alone(self) -> dict[str, float]:
        """What each kind adds to other values of the model's parameters."""
        known = self.share(("parameters",))
        kinds = [kind for kind in CAUSES if kind in self.columns or kind == "time"]
        return {kind: self.share(("parameters", kind)) - known for kind in kinds}

    def in_turn(self) -> dict[str, float]:
        """What each kind adds to the stronger ones, while that is worth naming."""
        shares = {"parameters": self.share(("parameters",))}
        found, least = (
            {kind: shares["parameters"] + adds for kind, adds in self.alone.items()},
            0.0,
        )
        while True:
            known = sum(shares.values())
            found = {
                kind: share for kind, share in found.items() if share > known + least
            }
            if not found:
                return shares
            kind = next(
                k for k in found if found[k] >= max(found.values()) - TIED_CAUSES / 2
            )
            shares[kind], least = found[kind] - known, SECOND_CAUSE
            found = {k: self.share((*shares, k)) for k in self.alone if k not in shares}

    def sentence(self, shares: Mapping[str, float]) -> str:
        """What the force does, in words, with the share of each cause."""
        if sum(shares.values()) < CLEAR_PATTERN:
            return "no clear pattern"
        named = [
            kind
            for kind, share in shares.items()
            if share > (NAMED_CAUSE if kind in CAUSES else 0.5)
        ]
        said = ", and ".join(
            f"{self._words(kind)} ({100 * shares[kind]:.0f} %)" for kind in named
        )
        return (said + self._tie(shares)) or "no clear pattern"

    def _tie(self, shares: Mapping[str, float]) -> str:
        first = next((kind for kind in shares if kind in CAUSES), "constant")
        if first == "constant" or shares[first] <= NAMED_CAUSE:
            return ""
        alike = [
            k
            for k, adds in self.alone.items()
            if k not in shares and adds > self.alone[first] - TIED_CAUSES
        ]
        return (
            f"; not told apart from one that {' or '.join(self._words(k) for k in alike)}"
            if alike
            else ""
        )

    def _words(self, kind: str) -> str:
        if kind == "parameters":
            return "is what other values of the model's own parameters would give"
        if kind == "constant":
            return f"is constant at {self.path.force_on(self.equation).mean():.3g}"
        if kind == "conserved":
            return self._exchange_words()
        if kind == "inputs":
            return f"follows {_listed(self.path.fit.model.inputs, 'input')}"
        return self._time_words() if kind == "time" else self._loss_words()

    def _exchange_words(self) -> str:
        names, momentum = (
            _partners(self.path, self.equation),
            _is_momentum(self.path.fit.model, self.equation),
        )
        return f"stores and returns energy (it follows {_listed(names, 'position' if momentum else 'state')})"

    def _loss_words(self) -> str:
        model, effort = self.path.fit.model, self.path.effort_of(self.equation)
        if isinstance(model, FirstOrder):
            return f"follows {self.equation} itself"
        name = f"the {'velocity' if _is_momentum(model, self.equation) else 'effort'} dH_d{self.equation}"
        c = np.linalg.lstsq(
            self.columns["dissipated"], self.path.force_on(self.equation), rcond=None
        )[0]
        fitted = _odd(effort) @ c
        if _direction(fitted, effort) < -CLEAR_PATTERN:
            return f"takes energy out (it opposes {name})"
        if (
            _direction(
                fitted + self.path.losses[:, model.states.index(self.equation)], effort
            )
            < -CLEAR_PATTERN
        ):
            return f"changes how energy is lost (it follows {name}, by another law than the model's damping)"
        return f"feeds energy in (it pushes along {name})"

    def _time_words(self) -> str:
        period = period_of(self.path, self.equation)
        if period is None:
            return "depends on time: it changes slowly"
        return f"depends on time: period {period:.3g}{spaced(self.path.units.get('t', ''))}"


def period_of(path: ForceRecord, equation: str) -> float | None:
    """Period of the wave in a force that depends on time; None where slow changes are
    larger.
    """
    w = path.force_on(equation)
    everywhere = np.ones(len(w), dtype=bool)
    columns = of_time(path, w, everywhere)
    c = np.linalg.lstsq(columns, w, rcond=None)[0]
    if np.var(columns[:, :-4] @ c[:-4]) > np.var(columns[:, -4:] @ c[-4:]):
        return None
    return 1 / wave_of(path, w, everywhere)


def _direction(force: np.ndarray, effort: np.ndarray) -> float:
    """Mean power of a force over the product of rms force and rms effort: -1 for
    damping, 0 for none on the whole.
    """
    return float(
        force
        @ effort
        / max(float(np.linalg.norm(force) * np.linalg.norm(effort)), TINY)
    )


def plane_of(path: ForceRecord, equation: str) -> tuple[str, ...]:
    """Variables of a map of the force: position and velocity of a momentum, else the
    best two states (or the one).

    Another pair of states takes their place where the force follows only that pair.
    """
    model, found = path.fit.model, dependence(path, equation)
    best, own = (
        leading(found, equation),
        [name for name in found["variable"] if name in model.states][:2],
    )
    if _is_momentum(model, equation):
        (q,) = (
            model.states[i]
            for i in position_rows(model)
            if model.S[i][model.states.index(equation)]
        )
        own = [q, f"dH_d{equation}"]
    if best is None or "," not in best["variable"] or best["share"] < CLEAR_PATTERN:
        return tuple(own)
    pair = best["variable"].split(", ")
    return tuple(own if equation in pair and own[0] in pair else pair)


def _is_momentum(model: Model, equation: str) -> bool:
    return any(
        model.S[i][model.states.index(equation)] != 0 for i in position_rows(model)
    )


def _partners(path: ForceRecord, equation: str) -> tuple[str, ...]:
    """States that the equation exchanges energy with: all positions for a momentum,
    otherwise those in its row of S.
    """
    model = path.fit.model
    row = np.flatnonzero(np.array(model.S)[model.states.index(equation)])
    found = position_rows(model) if _is_momentum(model, equation) else row
    return tuple(model.states[int(j)] for j in found)


def _odd(effort: np.ndarray) -> np.ndarray:
    """Piecewise linear odd functions of the effort; they jump at zero."""
    return np.asarray(np.sign(effort)[:, None] * hats(np.abs(effort), N_KNOTS // 2))


def _sum_of(path: ForceRecord, names: Sequence[str]) -> np.ndarray:
    """Functions of each variable; of two variables also those of both."""
    columns = [hats(path.variable(name), N_KNOTS) for name in names]
    if len(names) == 2:
        columns.append(pair_of(path.variable(names[0]), path.variable(names[1])))
    return np.hstack(columns)


def _listed(names: Sequence[str], what: str) -> str:
    return f"the {what}{'s' if len(names) > 1 else ''} {', '.join(names)}"

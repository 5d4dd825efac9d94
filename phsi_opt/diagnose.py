"""Where a model fails, and which effect is missing.

1. The missing force along every trajectory, with the states it implies (`missing`).
2. Every effect of the catalogue is screened on the whole record: the likelihood linearised at those states, one
   factorisation for all, one right-hand side per candidate. Frequencies are scanned in the same way.
3. The best few are re-fitted by maximum likelihood and judged by BIC, with residuals that are correlated counted for
   the independent ones they are worth, and by the free run on data held out.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
import pandas as pd
from scipy.sparse import csc_matrix, diags, hstack
from scipy.stats import chi2

from phsi_opt.compare import Comparison, compare, force_of
from phsi_opt.effects import Effect, catalogue
from phsi_opt.errors import PhsiOptError
from phsi_opt.fit import Fit
from phsi_opt.grid import defect_jacobian, defects, output_slopes
from phsi_opt.identify import identify, matched
from phsi_opt.linear import Reduced
from phsi_opt.losses import MaximumLikelihood
from phsi_opt.measurements import Measurements
from phsi_opt.missing import ForceEstimate, Sensed, force_deviation
from phsi_opt.model import Model
from phsi_opt.record import matrix_of, parameters_of
from phsi_opt.start import frequencies, resolved
from phsi_opt.terms import Scan
from phsi_opt.theta import Theta
from phsi_opt.uncertainty import inverse

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SCHEME = "srk4"
N_REFITS = 3
P_VALUE = 0.01  # of the best candidate, after Bonferroni's correction for the number of candidates
CONFUSABLE = 0.95  # correlation of two candidates' traces in the record beyond which they cannot be told apart
FALL = 1.65  # standard errors by which the held-out error must fall (one-sided 5 %)
ABOVE_FLOOR = 1.1  # free-run error over the noise floor from which a model counts as failing

NOTHING, NAMED, UNEXPLAINED = "nothing missing", "missing: named", "missing: unexplained"


@dataclass(frozen=True, eq=False)
class Candidate:
    """One effect with what screening expects of it, and, if it was re-fitted, what came out."""

    effect: Effect
    coefficient: float
    std_error: float
    drop: float  # expected fall of the misfit, in units of the noise variance
    columns: np.ndarray = field(repr=False, default_factory=lambda: np.zeros(0))
    values: dict[str, float] = field(default_factory=dict)
    confusable_with: tuple[str, ...] = ()
    p_value: float = np.nan
    delta_bic: float = np.nan
    fit: Fit | None = field(repr=False, default=None)
    comparison: Comparison | None = field(repr=False, default=None)

    @property
    def held_out_rmse(self) -> float:
        """Free-run error of the re-fitted model on the data held out (on the training data where none were)."""
        return np.nan if self.comparison is None else self.comparison.rmse


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What `diagnose` found: `verdict`, `reason`, `where`, `missing_force`, `candidates`, `effects`."""

    fit: Fit
    estimate: ForceEstimate = field(repr=False)
    base: Comparison = field(repr=False)
    ranked: tuple[Candidate, ...] = field(repr=False)
    verdict: str
    reason: str

    @property
    def effects(self) -> list[Effect]:
        """The candidate effects, best first."""
        return [candidate.effect for candidate in self.ranked]

    @property
    def candidates(self) -> pd.DataFrame:
        """The candidates, best first, as a table with the columns named below.

        p_value, delta_bic and held_out_rmse are those of the re-fit, NaN for candidates that screening ruled out.
        """
        rows = [
            (c.effect.name, c.effect.slot, c.effect.equation, c.coefficient, c.std_error, c.p_value, c.delta_bic,
             c.held_out_rmse, ", ".join(c.confusable_with))
            for c in self.ranked
        ]  # fmt: skip
        columns = ["effect", "slot", "equation", "coefficient", "std_error", "p_value", "delta_bic", "held_out_rmse"]
        return pd.DataFrame(rows, columns=[*columns, "confusable_with"])

    @property
    def missing_force(self) -> pd.DataFrame:
        """trajectory, t (middle of the interval), then force and standard deviation per equation."""
        grid = self.estimate.grid
        frame = pd.DataFrame({"trajectory": grid.trajectory[grid.begin], "t": grid.t[grid.begin] + grid.h / 2})
        deviation = force_deviation(self.estimate)
        for k, row in enumerate(self.estimate.prior.rows):
            name = self.fit.model.states[row]
            frame[name], frame[f"std_{name}"] = self.estimate.w[:, k], deviation[:, k]
        return frame

    @property
    def where(self) -> pd.DataFrame:
        """Strongest first: equation, trajectory, time window, state region, frequency, strength (rms of the force)."""
        rows = [_where(self, k, row) for k, row in enumerate(self.estimate.prior.rows)]
        columns = ["equation", "trajectory", "time_window", "state_region", "frequency", "strength"]
        return pd.DataFrame(rows, columns=columns).sort_values("strength", ascending=False, ignore_index=True)

    def plot(self, ax: "Axes | None" = None, trajectory: int = 0) -> "Axes":
        """The missing force along one trajectory, with its standard deviation."""
        from phsi_opt.plotting import plot_missing_force

        return plot_missing_force(self, ax, trajectory)

    def __str__(self) -> str:
        shown = self.candidates.head(6).to_string(index=False, float_format=lambda v: f"{v:.4g}")
        where = self.where.to_string(index=False, float_format=lambda v: f"{v:.4g}")
        return f"{self.verdict}: {self.reason}\nwhere it fails\n{where}\ncandidates, best first\n{shown}"

    __repr__ = __str__


def diagnose(
    fit: Fit,
    data: Measurements,
    held_out: Measurements | None = None,
    *,
    effects: list[Effect] | None = None,
    loss: MaximumLikelihood | None = None,
    progress: Callable[[str], None] | None = None,
) -> Diagnosis:
    """Estimate what the fitted model lacks on ``data`` and name it, if the data allow (see the module's text).

    Args:
        held_out: measurements not used for fitting; without them the verdict rests on the training record alone.
        effects: candidates; default: `catalogue` of the model. loss: how candidates are re-fitted.
        progress: called with a line of text as the work goes on.
    """
    say = progress or (lambda line: None)
    data = matched(fit.model, data)
    say("estimating the missing force")
    estimate = force_of(fit, data)
    base = compare(fit, data if held_out is None else held_out)
    listed = catalogue(fit.model) if effects is None else effects
    say(f"screening {len(listed)} candidate effects")
    ranked = _screened(fit, data, estimate, listed)
    trained = compare(fit, data)
    refitted = []
    for candidate in ranked[:N_REFITS]:
        say(f"re-fitting with {candidate.effect}")
        refitted.append(
            _refitted(candidate, fit, trained, estimate, data, held_out, len(listed), loss or MaximumLikelihood())
        )
    refitted.sort(key=lambda c: (c.fit is None, np.nan_to_num(c.delta_bic, nan=np.inf)))
    everyone = tuple(refitted) + tuple(ranked[N_REFITS:])
    verdict, reason = _verdict(everyone, base, held_out is not None)
    return Diagnosis(fit, estimate, base, everyone, verdict, reason)


def _screened(fit: Fit, data: Measurements, estimate: ForceEstimate, effects: list[Effect]) -> list[Candidate]:
    """Candidates with expected coefficient, standard error and fall of the misfit; the largest fall first."""
    test = _ScoreTest(fit, data, estimate)
    found = [candidate for effect in effects if (candidate := test.candidate(effect)) is not None]
    found.sort(key=lambda c: -c.drop)
    return [replace(c, confusable_with=_confusable(c, found)) for c in found]


def _confusable(candidate: Candidate, others: list[Candidate]) -> tuple[str, ...]:
    def alike(a: np.ndarray, b: np.ndarray) -> bool:
        return abs(float(a @ b)) > CONFUSABLE * float(np.linalg.norm(a) * np.linalg.norm(b))

    return tuple(str(o.effect) for o in others if o is not candidate and alike(candidate.columns, o.columns))


class _ScoreTest:
    """The likelihood of the whole record linearised at the states of the missing-force estimate.

    minimise 1/2 |r - C dx|^2 subject to d + A dx + B dtheta + Phi c = 0: base parameters move
    along, c is the candidate's.
    """

    def __init__(self, fit: Fit, data: Measurements, estimate: ForceEstimate) -> None:
        model = fit.model
        self.model, self.estimate, self.grid = model, estimate, estimate.grid
        grid, x = self.grid, estimate.x
        unknown = Theta.of(model, tuple(run.name for run in data.trajectories))
        self.values = matrix_of(model, parameters_of(fit, data))  # (n_free, n_trajectories)
        theta = np.zeros(len(unknown))
        theta[unknown.table] = self.values
        symbol, free = ca.MX.sym("x", x.size), ca.MX.sym("theta", len(unknown))
        states = ca.reshape(symbol, model.n_states, grid.n_nodes)
        d = ca.vec(defects(model, grid, SCHEME, states, unknown.by_trajectory(free)))
        value, A, B = ca.Function("linear", [symbol, free], [d, ca.jacobian(d, symbol), ca.jacobian(d, free)])(
            x.ravel(), theta
        )
        of_runs, n_theta = unknown.by_trajectory(theta), len(unknown)
        sensed, seen = Sensed.at(model, grid, x, of_runs), grid.measured
        weight = diags(np.where(seen, 1 / estimate.sigma, 0.0).ravel())
        slopes, through_sensors = self._scaled(csc_matrix(B.sparse()), weight @ self._sensor_columns(unknown, of_runs))
        self.seen_of = csc_matrix(hstack([through_sensors, weight @ sensed.slope]))  # from theta and x to residuals
        r = np.where(seen, (grid.y - sensed.shown) / estimate.sigma, 0.0).ravel()
        x_places = slice(n_theta, n_theta + x.size)
        hessian = csc_matrix(self.seen_of.T @ self.seen_of)
        self.reduced = Reduced(grid, model.n_states, hessian, hstack([slopes, A.sparse()]), slice(0, n_theta), x_places)
        self.covariance = inverse(self.reduced.information)
        g = self.seen_of.T @ r
        step = self.reduced.solve(g[n_theta:], -np.array(value).ravel(), self.covariance, g[:n_theta])
        self.residual = r - self.seen_of @ np.concatenate(step)

    def _sensor_columns(self, unknown: Theta, of_runs: np.ndarray) -> csc_matrix:
        """Slope of what the sensors show in every parameter, (n_values, n_theta)."""
        model, grid, x = self.model, self.grid, self.estimate.x
        columns = np.zeros((grid.n_nodes, model.n_states, len(unknown)))
        if model.sensor:
            places = unknown.table[:, grid.trajectory].T[:, None, :]
            slopes = output_slopes(model, grid, x, of_runs)[1]
            np.put_along_axis(columns, np.broadcast_to(places, slopes.shape), slopes, axis=2)
        return csc_matrix(columns.reshape(x.size, len(unknown)))

    @staticmethod
    def _scaled(B: csc_matrix, D: csc_matrix) -> tuple[csc_matrix, csc_matrix]:
        norms = np.sqrt(np.asarray(B.power(2).sum(axis=0) + D.power(2).sum(axis=0)).ravel())
        scale = diags(1 / np.where(norms > 0, norms, 1.0))
        return csc_matrix(B @ scale), csc_matrix(D @ scale)

    def traces(self, columns: np.ndarray) -> np.ndarray:
        """What each column (a force, as a change of the defects) does to the weighted residuals, base re-estimated."""
        return np.asarray(self.seen_of @ np.concatenate(self.reduced.respond(-columns, self.covariance)))

    def candidate(self, effect: Effect) -> Candidate | None:
        """Expected coefficient, its standard error, expected fall of the misfit; None for an effect without trace."""
        try:
            model = resolved(self.model.add(effect), self.grid, self.estimate.x)
        except PhsiOptError:
            return None
        coefficients = [n for n, e in model.entries.items() if n not in self.model.entries and e.prunable]
        scanned = [
            n for n, e in model.entries.items() if n not in self.model.entries and isinstance(e.parameter.guess, Scan)
        ]
        values: dict[str, float] = {}
        if scanned and coefficients:
            columns = self._jacobian(model, coefficients)
            best = max(self._frequencies(), key=lambda w: self._drop(self._columns(model, columns, {scanned[0]: w}))[2])
            values = {scanned[0]: float(best)}
        elif not coefficients:
            coefficients = [n for n in model.free if n not in self.model.entries]
        if not coefficients:
            return None
        columns = self._jacobian(model, coefficients)
        return self._judged(effect, model, coefficients, values, self._columns(model, columns, values))

    def _columns(self, model: Model, function: ca.Function, values: dict[str, float]) -> np.ndarray:
        old = dict(zip(self.model.free, self.values, strict=True))
        n = self.values.shape[1]
        theta = [old.get(name, np.full(n, values.get(name, model.values[name]))) for name in model.free]
        return np.nan_to_num(np.array(function(self.estimate.x.T, np.array(theta))))

    def _jacobian(self, model: Model, names: list[str]) -> ca.Function:
        chosen = [model.free.index(name) for name in names]
        return defect_jacobian(model, self.grid, SCHEME, chosen, self.values.shape[1])

    def _frequencies(self) -> np.ndarray:
        return frequencies(self.grid, self.grid.t)[:400]

    def _drop(self, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray, float, np.ndarray]:
        traces = self.traces(columns)
        # residual(c) = residual - traces c
        information = traces.T @ traces
        information = (
            information + 1e-12 * np.trace(information) * np.eye(len(information)) + 1e-300 * np.eye(len(information))
        )
        c = np.linalg.solve(information, traces.T @ self.residual)
        return c, information, float(c @ information @ c), traces

    def _judged(
        self, effect: Effect, model: Model, names: list[str], values: dict[str, float], columns: np.ndarray
    ) -> Candidate | None:
        c, information, drop, traces = self._drop(columns)
        if np.trace(information) < 1e-6:
            return None
        allowed = [model.entries[n].parameter for n in names]
        if any(not p.lower <= value <= p.upper for p, value in zip(allowed, c, strict=True)):
            drop = 0.0  # physics forbids the sign that the data ask for
        left = max(float(self.residual @ self.residual) - drop, 1.0) / max(int(self.grid.measured.sum()) - len(c), 1)
        error = np.sqrt(np.diag(np.linalg.inv(information)) * max(left, 1.0))
        size = float(np.hypot(*c)) if len(c) == 2 else float(c[0])
        start = {
            **values,
            **{n: float(np.clip(v, p.lower, p.upper)) for n, v, p in zip(names, c, allowed, strict=True)},
        }
        return Candidate(effect, size, float(np.max(error)), drop, traces @ c, start)


def _refitted(
    candidate: Candidate, fit: Fit, before: Comparison, estimate: ForceEstimate, data: Measurements,
    held_out: Measurements | None, tried: int, loss: MaximumLikelihood,
) -> Candidate:  # fmt: skip
    """The candidate re-fitted by maximum likelihood from the states of the missing-force estimate, and judged."""
    grid = estimate.grid
    states = tuple(estimate.x[(grid.trajectory == i) & grid.sample] for i in range(data.n_trajectories))
    model = resolved(fit.model.add(candidate.effect), grid, estimate.x)
    noise = {name: float(s) for name, s in zip(model.states, estimate.sigma, strict=True) if name in data.measured}
    start = replace(fit, model=model.with_values(candidate.values), states=states, noise=noise)
    try:
        new = identify(model.with_values(candidate.values), data, loss, start=start)
        comparison = compare(new, data if held_out is None else held_out)
        trained = compare(new, data)
    except PhsiOptError:
        return candidate
    names = [n for n, e in new.model.entries.items() if n not in fit.model.entries and not e.parameter.fixed]
    size, error = _size(new, [n for n in names if new.model.entries[n].prunable] or names)
    bic, p_value = _evidence(before, trained, len(names))
    return replace(
        candidate, coefficient=size, std_error=error, fit=new, comparison=comparison, delta_bic=bic,
        p_value=min(1.0, p_value * tried),
    )  # fmt: skip


def _size(fit: Fit, names: list[str]) -> tuple[float, float]:
    """Coefficient (amplitude, for a pair) and its standard error."""
    values = np.array([fit.values[n] for n in names])
    at = [fit.names.index(n) for n in names]
    covariance = fit.covariance[np.ix_(at, at)]
    if len(names) == 1:
        return float(values[0]), float(np.sqrt(covariance[0, 0]))
    size = float(np.linalg.norm(values))
    direction = values / max(size, 1e-300)
    return size, float(np.sqrt(direction @ covariance @ direction))


def _evidence(old: Comparison, new: Comparison, n_new: int) -> tuple[float, float]:
    """Change of BIC and p-value from the free-run residuals, correlated residuals counted as fewer independent ones."""
    n = independent_samples(new)
    gain = n * np.log(max(old.rmse, 1e-300) ** 2 / max(new.rmse, 1e-300) ** 2)
    return float(n_new * np.log(n) - gain), float(chi2.sf(max(gain, 0.0), n_new))


def independent_samples(comparison: Comparison) -> float:
    """Number of independent samples that the residuals are worth, by their correlation at the first lag."""
    products, squares = 0.0, 0.0
    for run in comparison.residuals:
        for column in (run * comparison.weights).T:
            r = column[np.isfinite(column)]
            products, squares = products + float(np.sum(r[1:] * r[:-1])), squares + float(np.sum(r**2))
    correlation = np.clip(products / squares if squares > 0 else 0.0, 0.0, 0.999)
    measured = sum(int(np.isfinite(run.x).sum()) for run in comparison.data.trajectories)
    return max(measured * (1 - correlation) / (1 + correlation), 3.0)


def falls(old: Comparison, new: Comparison) -> bool:
    """Whether the error of ``new`` on the same data is significantly below ``old``'s (blocks of residuals, paired)."""
    difference = old.squares - new.squares
    n_blocks = int(np.clip(min(independent_samples(old), independent_samples(new)) / 2, 4, 40))
    means = np.array([block.mean() for block in np.array_split(difference, n_blocks)])
    spread = means.std(ddof=1) / np.sqrt(n_blocks)
    return bool(means.mean() > FALL * spread and new.rmse < old.rmse)


def _verdict(ranked: tuple[Candidate, ...], base: Comparison, is_held_out: bool) -> tuple[str, str]:
    where = "held-out" if is_held_out else "training"
    ratio = base.rmse / base.noise_floor
    errors = f"{where} error {base.rmse:.4g}, noise floor {base.noise_floor:.4g}"
    c = _significant(ranked, base)
    if c is not None:
        tie = f"; not told apart from {', '.join(c.confusable_with)}" if c.confusable_with else ""
        return NAMED, (
            f"{c.effect}, coefficient {c.coefficient:.4g} +- {c.std_error:.2g}; the {where} error falls from "
            f"{base.rmse:.4g} to {c.held_out_rmse:.4g} (noise floor {base.noise_floor:.4g}){tie}"
        )
    if ratio < ABOVE_FLOOR:
        return NOTHING, f"{errors}; no effect of the catalogue lowers it significantly"
    return UNEXPLAINED, f"{errors}, but no effect of the catalogue lowers it significantly"


def best_candidate(diagnosis: Diagnosis) -> Candidate | None:
    """The candidate that the verdict names."""
    return _significant(diagnosis.ranked, diagnosis.base)


def _significant(ranked: tuple[Candidate, ...], base: Comparison) -> Candidate | None:
    """The first candidate whose BIC and p-value hold and with which the error on the judging data falls."""
    for c in ranked:
        if c.comparison is not None and c.p_value < P_VALUE and c.delta_bic < 0 and falls(base, c.comparison):
            return c
    return None


def _where(diagnosis: Diagnosis, k: int, row: int) -> tuple[Any, ...]:
    """Where the force of one equation is strongest: a tenth of a trajectory, a region of the states, a frequency."""
    estimate, model = diagnosis.estimate, diagnosis.fit.model
    grid, w = estimate.grid, estimate.w[:, k]
    windows = []
    for run in range(int(grid.trajectory[-1]) + 1):
        of_run = np.flatnonzero(grid.trajectory[grid.begin] == run)
        windows += [
            (float(np.sqrt(np.mean(w[part] ** 2))), run, part) for part in np.array_split(of_run, 10) if len(part)
        ]
    _, run, part = max(windows, key=lambda window: window[0])
    span = f"{grid.t[grid.begin[part[0]]]:.3g} to {grid.t[grid.begin[part[-1]] + 1]:.3g}"
    strong = np.abs(w) >= np.quantile(np.abs(w), 0.75)
    region = ", ".join(_range(model.states[i], estimate.x[grid.begin[strong], i]) for i in range(model.n_states))
    longest = np.flatnonzero(grid.trajectory[grid.begin] == np.bincount(grid.trajectory[grid.begin]).argmax())
    spectrum = np.abs(np.fft.rfft(w[longest] - w[longest].mean()))
    peak = np.fft.rfftfreq(len(longest), float(np.median(grid.h)))[int(np.argmax(spectrum))]
    return model.states[row], run, span, region, float(peak), float(np.sqrt(np.mean(w**2)))


def _range(name: str, values: np.ndarray) -> str:
    low, high = np.quantile(values, [0.1, 0.9])
    return f"{name} {low:.3g} to {high:.3g}"

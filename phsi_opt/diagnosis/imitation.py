"""How well one fitted model imitates another: a fit to what the other one shows."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from phsi_opt.comparison.compare import compare
from phsi_opt.data.checks import hold_of_each
from phsi_opt.data.measurements import Measurements
from phsi_opt.diagnosis.experiments import Experiment
from phsi_opt.errors import PhsiOptError
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.identify import identify
from phsi_opt.model.model import Model
from phsi_opt.simulation.simulate import Runs, rates
from phsi_opt.transcription.losses import MaximumLikelihood

# Steps of an imitation, in those of the fit, whose errors are a tenth of the noise: of
# order four, they are then far below what an experiment could show.
FINER_STEPS = 4
# Change by twice the steps, in standard deviations of each state, that what a model
# shows may have.
SHOWN_TOLERANCE = 1e-6


@dataclass(frozen=True, eq=False)
class FittedModel:
    """A fitted model in one trajectory of its measurements.

    Attributes:
        fit: of the model.
        data: the measurements it was fitted to.
        number: of the trajectory.
    """

    fit: Fit
    data: Measurements
    number: int

    @cached_property
    def model(self) -> Model:
        """With the parameters of the trajectory, of which none is its own."""
        own = self.fit.model_of(self.data.trajectories[self.number].name)
        shared = own.with_fixed({name: own.values[name] for name in own.free})
        return shared.with_free(own.free)

    @cached_property
    def x0(self) -> np.ndarray:
        """(n_states,) its start there."""
        fit = self.fit
        knows_states = len(fit.states) == self.data.n_trajectories
        runs = fit.states if knows_states else compare(fit, self.data).simulated
        return np.asarray(runs[self.number][0])

    @cached_property
    def _runs(self) -> Runs:
        return Runs(rates(self.model))

    def shown(self, experiment: Experiment, names: Sequence[str]) -> np.ndarray | None:
        """What sensors of the named states show in an experiment.

        Returns:
            (n_samples, n_names); None where the model cannot be simulated.
        """
        model = self.model
        inputs = [self.data.inputs.index(name) for name in model.inputs]
        hold = hold_of_each(self.data.hold, self.data.inputs)[inputs]
        u = experiment.u[:, inputs]
        x0 = experiment.start(model, self.x0)
        x = self._runs.run(experiment.t, x0, u, hold, SHOWN_TOLERANCE)
        if x is None:
            return None
        n_samples = len(x)
        theta = np.tile(model.theta[:, None], n_samples)
        output = model.output().map(n_samples)
        y = output(x.T, u.T, experiment.t[None], theta).full().T
        return np.asarray(y[:, [model.index(name) for name in names]])

    def measurements(self, experiments: Sequence[Experiment]) -> Measurements | None:
        """The model's course through experiments, as if it were measured without noise.

        None where the model cannot be simulated.
        """
        data = self.data
        runs = []
        for experiment in experiments:
            shown = self.shown(experiment, experiment.measured)
            if shown is None:
                return None
            x = np.full((len(shown), len(data.states)), np.nan)
            x[:, [data.states.index(name) for name in experiment.measured]] = shown
            runs.append(x)
        return Measurements.from_arrays(
            [experiment.t for experiment in experiments],
            runs,
            [experiment.u for experiment in experiments] if data.inputs else None,
            states=data.states,
            inputs=data.inputs,
            names=[experiment.name for experiment in experiments],
            units=data.units,
            hold=data.hold,
        )

    def misfit(self, shown: Measurements, noise: dict[str, float]) -> float | None:
        """What the best imitation leaves, in noise variances; None where none is found.

        Args:
            shown: what is imitated, each run from a start of its own.
            noise: standard deviation by measured state.
        """
        most = max((int(np.max(steps)) for steps in self.fit.steps), default=1)
        known = {name: noise[name] for name in shown.measured}
        loss = MaximumLikelihood(noise=known, steps=FINER_STEPS * most)
        try:
            found = identify(self.model, shown, loss)
        except PhsiOptError:
            return None
        return float(found.loss_value * found.n_values)

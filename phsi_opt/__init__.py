"""Identify energy-based models of dynamical systems from measurements.

A name is imported from its module when it is first asked for, so that a command such as
``phsi-opt --help`` does not wait for the solver's libraries.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from phsi_opt.comparison.bootstrap import Bootstrap, bootstrap
    from phsi_opt.comparison.compare import Comparison, compare
    from phsi_opt.comparison.profile_likelihood import Profile, profile
    from phsi_opt.data.measurements import Measurements
    from phsi_opt.data.trajectory import Trajectory
    from phsi_opt.diagnosis.candidate import Candidate
    from phsi_opt.diagnosis.diagnose import diagnose
    from phsi_opt.diagnosis.finding import Finding
    from phsi_opt.diagnosis.record import Diagnosis
    from phsi_opt.diagnosis.verdict import Verdict
    from phsi_opt.errors import (
        Complaint,
        DataError,
        ModelError,
        PhsiOptError,
        SolveError,
        StudyFileError,
    )
    from phsi_opt.estimation.fit import Fit
    from phsi_opt.estimation.identify import identify
    from phsi_opt.estimation.pruning import Pruning
    from phsi_opt.model.catalogue import catalogue
    from phsi_opt.model.effect import Effect
    from phsi_opt.model.model import FirstOrder, Model, PseudoHamiltonian
    from phsi_opt.model.parameters import Parameter
    from phsi_opt.model.structure import canonical
    from phsi_opt.model.terms import damping, formula, polynomials, trigonometric
    from phsi_opt.optimization.settings import SolverSettings
    from phsi_opt.simulation.simulate import simulate
    from phsi_opt.study.study import Study
    from phsi_opt.study_file.sections import Channel, DataSection, HeldOut, Times
    from phsi_opt.study_file.study_file import StudyFile
    from phsi_opt.sweeps.sweep import sweep
    from phsi_opt.transcription.losses import MaximumLikelihood, PHSILoss

# The public names by the module that defines them: the imports above, for run time.
MODULES = {
    "comparison.bootstrap": "Bootstrap bootstrap",
    "comparison.compare": "Comparison compare",
    "comparison.profile_likelihood": "Profile profile",
    "data.measurements": "Measurements",
    "data.trajectory": "Trajectory",
    "diagnosis.candidate": "Candidate",
    "diagnosis.diagnose": "diagnose",
    "diagnosis.finding": "Finding",
    "diagnosis.record": "Diagnosis",
    "diagnosis.verdict": "Verdict",
    "errors": "Complaint DataError ModelError PhsiOptError SolveError StudyFileError",
    "estimation.fit": "Fit",
    "estimation.identify": "identify",
    "estimation.pruning": "Pruning",
    "model.catalogue": "catalogue",
    "model.effect": "Effect",
    "model.model": "FirstOrder Model PseudoHamiltonian",
    "model.parameters": "Parameter",
    "model.structure": "canonical",
    "model.terms": "damping formula polynomials trigonometric",
    "optimization.settings": "SolverSettings",
    "simulation.simulate": "simulate",
    "study.study": "Study",
    "study_file.sections": "Channel DataSection HeldOut Times",
    "study_file.study_file": "StudyFile",
    "sweeps.sweep": "sweep",
    "transcription.losses": "MaximumLikelihood PHSILoss",
}


__all__ = [
    "Bootstrap",
    "Candidate",
    "Channel",
    "Comparison",
    "Complaint",
    "DataError",
    "DataSection",
    "Diagnosis",
    "Effect",
    "Finding",
    "FirstOrder",
    "Fit",
    "HeldOut",
    "MaximumLikelihood",
    "Measurements",
    "Model",
    "ModelError",
    "PHSILoss",
    "Parameter",
    "PhsiOptError",
    "Profile",
    "Pruning",
    "PseudoHamiltonian",
    "SolveError",
    "SolverSettings",
    "Study",
    "StudyFile",
    "StudyFileError",
    "Times",
    "Trajectory",
    "Verdict",
    "bootstrap",
    "canonical",
    "catalogue",
    "compare",
    "damping",
    "diagnose",
    "formula",
    "identify",
    "polynomials",
    "profile",
    "simulate",
    "sweep",
    "trigonometric",
]


if not TYPE_CHECKING:  # a type checker sees the imports above

    def __getattr__(name: str) -> Any:
        """A public name, imported from its module."""
        for module, names in MODULES.items():
            if name in names.split():
                value = getattr(import_module(f"{__name__}.{module}"), name)
                globals()[name] = value  # the next time it is found at once
                return value
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """The public names."""
    return list(__all__)

"""Identify energy-based models of dynamical systems from measurements."""

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
from phsi_opt.study import Study
from phsi_opt.study_file.sections import Channel, DataSection, HeldOut
from phsi_opt.study_file.study_file import StudyFile
from phsi_opt.transcription.losses import MaximumLikelihood, PHSILoss

__all__ = [
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
    "Trajectory",
    "Verdict",
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
    "trigonometric",
]

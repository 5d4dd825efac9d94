"""phsi_opt: identify energy-based models of dynamical systems from measurements, by optimisation."""

from phsi_opt.compare import Comparison, compare
from phsi_opt.diagnose import diagnose
from phsi_opt.diagnosis import Diagnosis
from phsi_opt.effects import Effect, catalogue
from phsi_opt.errors import DataError, ModelError, PhsiOptError, SolveError
from phsi_opt.fit import Fit
from phsi_opt.identify import identify
from phsi_opt.losses import MaximumLikelihood, MissingForce, PHSILoss
from phsi_opt.measurements import Measurements, Trajectory
from phsi_opt.model import FirstOrder, PseudoHamiltonian, canonical
from phsi_opt.profile import Profile, profile
from phsi_opt.pruning import Pruning
from phsi_opt.simulate import simulate
from phsi_opt.solver import Settings
from phsi_opt.study import Study
from phsi_opt.terms import Parameter, damping, formula, polynomials, trigonometric

__all__ = [
    "Comparison",
    "DataError",
    "Diagnosis",
    "Effect",
    "FirstOrder",
    "Fit",
    "MaximumLikelihood",
    "Measurements",
    "MissingForce",
    "ModelError",
    "PHSILoss",
    "Parameter",
    "PhsiOptError",
    "Profile",
    "Pruning",
    "PseudoHamiltonian",
    "Settings",
    "SolveError",
    "Study",
    "Trajectory",
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

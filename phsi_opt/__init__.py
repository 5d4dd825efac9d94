"""phsi_opt: identify energy-based models of dynamical systems from measurements, by optimisation."""

from phsi_opt.errors import DataError, ModelError, PhsiOptError, SolveError
from phsi_opt.fit import Fit
from phsi_opt.identify import identify
from phsi_opt.losses import MaximumLikelihood, MissingForce, PHSILoss
from phsi_opt.measurements import Measurements, Trajectory
from phsi_opt.model import FirstOrder, PseudoHamiltonian, canonical
from phsi_opt.pruning import Pruning
from phsi_opt.simulate import simulate
from phsi_opt.solver import Settings
from phsi_opt.terms import Parameter, damping, formula, polynomials, trigonometric

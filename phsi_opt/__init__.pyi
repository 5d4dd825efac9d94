"""The public names by the module that defines them; `__init__.py` imports by it."""

from phsi_opt.comparison.compare import Comparison as Comparison
from phsi_opt.comparison.compare import compare as compare
from phsi_opt.comparison.profile_likelihood import Bootstrap as Bootstrap
from phsi_opt.comparison.profile_likelihood import Profile as Profile
from phsi_opt.comparison.profile_likelihood import bootstrap as bootstrap
from phsi_opt.comparison.profile_likelihood import profile as profile
from phsi_opt.data.measurements import Measurements as Measurements
from phsi_opt.data.trajectory import Trajectory as Trajectory
from phsi_opt.diagnosis.candidate import Candidate as Candidate
from phsi_opt.diagnosis.candidate import Finding as Finding
from phsi_opt.diagnosis.candidate import Verdict as Verdict
from phsi_opt.diagnosis.diagnose import diagnose as diagnose
from phsi_opt.diagnosis.record import Diagnosis as Diagnosis
from phsi_opt.errors import Complaint as Complaint
from phsi_opt.errors import DataError as DataError
from phsi_opt.errors import ModelError as ModelError
from phsi_opt.errors import PhsiOptError as PhsiOptError
from phsi_opt.errors import SolveError as SolveError
from phsi_opt.errors import StudyFileError as StudyFileError
from phsi_opt.estimation.estimate import Pruning as Pruning
from phsi_opt.estimation.fit import Fit as Fit
from phsi_opt.estimation.identifiability import Identifiability as Identifiability
from phsi_opt.estimation.identifiability import identifiability as identifiability
from phsi_opt.estimation.identify import identify as identify
from phsi_opt.estimation.prediction import Prediction as Prediction
from phsi_opt.model.blocks import BlockDiagram as BlockDiagram
from phsi_opt.model.blocks import blocks as blocks
from phsi_opt.model.catalogue import catalogue as catalogue
from phsi_opt.model.effect import Effect as Effect
from phsi_opt.model.from_sympy import from_sympy as from_sympy
from phsi_opt.model.mechanics import mechanical as mechanical
from phsi_opt.model.model import FirstOrder as FirstOrder
from phsi_opt.model.model import Model as Model
from phsi_opt.model.model import PseudoHamiltonian as PseudoHamiltonian
from phsi_opt.model.parameters import Parameter as Parameter
from phsi_opt.model.poisson import casimirs as casimirs
from phsi_opt.model.poisson import is_poisson as is_poisson
from phsi_opt.model.structure import canonical as canonical
from phsi_opt.model.terms import damping as damping
from phsi_opt.model.terms import formula as formula
from phsi_opt.model.terms import polynomials as polynomials
from phsi_opt.model.terms import trigonometric as trigonometric
from phsi_opt.optimization.ipopt import SolverSettings as SolverSettings
from phsi_opt.simulation.simulate import simulate as simulate
from phsi_opt.study.study import Study as Study
from phsi_opt.study_file.sections import Channel as Channel
from phsi_opt.study_file.sections import DataSection as DataSection
from phsi_opt.study_file.sections import HeldOut as HeldOut
from phsi_opt.study_file.sections import Times as Times
from phsi_opt.study_file.study_file import StudyFile as StudyFile
from phsi_opt.sweeps.sweep import sweep as sweep
from phsi_opt.transcription.losses import MaximumLikelihood as MaximumLikelihood
from phsi_opt.transcription.losses import PHSILoss as PHSILoss

MODULES: dict[str, str]
__all__: list[str]

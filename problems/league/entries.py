"""Public sets under the protocol of those who published them: records and models.

Times, positions and inputs as they were published, every sample of them. States that
nobody measured are NaN.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

import phsi_opt as ph
from problems.league import f16, robot
from problems.measured import machines, storages, vibrations
from problems.measured.machines import positive


@dataclass(frozen=True)
class Entry:
    """A set of the league.

    Attributes:
        folder: of its files.
        n_first: samples of a test record from which its starting state is estimated;
            errors are counted from there on.
        unit: of the errors.
        per_unit: the error in the data's unit times this.
        train: the training record.
        tests: the test records, by name.
        base: a model that lacks what the set is known for.
        physics: the model with the physics that is published for the set.
        study: of the base model and the training record: the model after a study of
            two pieces of the record, and the effects that it added.
        published: errors that others have published.
        most: what the sensor shows at most.
        fit: how a model is fitted; None: by maximum likelihood.
        error: of a fit, a test record and the entry; None: of a state that is measured.
    """

    folder: str
    n_first: int
    unit: str
    per_unit: float
    train: Callable[[], Any]
    tests: Callable[[], Mapping[str, Any]]
    base: Callable[[], Any]
    physics: Callable[[], Any]
    study: Callable[[Any, Any], tuple[Any, list[str]]]
    published: str
    most: float = np.inf
    fit: Callable[[Any, Any], ph.Model] | None = None
    error: Callable[..., float] | None = None


# --- EMPS, a linear drive


def emps(name: str) -> ph.Measurements:
    """Position (m) and motor force (N) at 1 kHz."""
    return machines.one_run(*machines.emps_record(name), "zero")


def emps_pieces(_: ph.Measurements) -> tuple[ph.Measurements, ph.Measurements]:
    """Windows of 1 s of the training record, thinned, of which every other one is held
    out: over longer ones every small error of the base model is integrated twice.
    """
    windows = machines.emps("fit")
    return windows[0::2], windows[1::2]


# --- the Silverbox, an electronic Duffing oscillator

# Samples of the multisines and of the arrow, and the last one that is fitted.
BOX, ARROW, BOX_LAST = (40_650, 127_400), (100, 40_575), 105_712
ARROW_NO_EXTRAPOLATION = (100, 32_100)


def box(first: int, end: int) -> ph.Measurements:
    """Samples of output (V) and input (V), which is a smooth curve, without units."""
    (run,) = machines.box(first, end).trajectories
    return machines.one_run(run.t, run.x[:, 0], run.u[:, 0], "cubic")


def box_physics() -> ph.PseudoHamiltonian:
    """An oscillator with a spring of order three, an offset and linear loss."""
    a, b = ph.Parameter(0.0), ph.Parameter(0.0)
    text = "k*q**2/2 + a*q**3/3 + b*q**4/4 + p**2/2"
    force = ph.formula("c*u + d", c=ph.Parameter(1e5), d=ph.Parameter(0.0))
    return machines.oscillator(ph.formula(text, k=positive(1.9e5), a=a, b=b), force)


# --- the cascaded tanks


# By parameter: a rough value (each outflow empties its tank in a few minutes, a rim at
# the height of the sensor's limit) and an upper bound.
TANKS = {
    "k1": (0.01, 1),
    "k4": (0.05, 1),
    "q0": (0.05, 0.2),
    "c": (0.5, 2),
    "rim1": (10.0, 80),
    "k3": (0.03, 1),
    "h0": (2.0, 2.9),
    "s": (0.5, 1),
    "c2": (0.5, 2),
}


def tanks_physics() -> ph.FirstOrder:
    """Both overflows, a linear upper outflow, a square-root lower outflow from h0 on.

        dh1/dt = k4 u - q0 - k1 h1 - c over(h1 - rim1)
        dh2/dt = k1 h1 - k3 root(h2 - h0) + s c over(h1 - rim1) - c2 over(h2 - 10 V)

    A part s of what the upper tank spills falls into the lower one. ``over`` is a ramp
    with its corner rounded over 0.1 V. The constant loss q0 and the level h0 at which
    the lower outflow ends are empirical: the structure was chosen among some twenty on
    the last 30 % of the training record.
    """
    rim, limit = (
        f"({level} + sqrt({level}**2 + 0.01))/2"
        for level in ("(h1 - rim1)", f"(h2 - {storages.FULL})")
    )
    lower = "k3*(h2 - h0)*((h2 - h0)**2 + 0.01)**(-0.25)"
    texts = {
        "h1": f"k4*u - q0 - k1*h1 - c*{rim}",
        "h2": f"k1*h1 - {lower} + s*c*{rim} - c2*{limit}",
    }
    names = {"h1": ["k1", "k4", "q0", "c", "rim1"]}
    names["h2"] = ["k1", "k3", "h0", "c", "rim1", "s", "c2"]
    free = {n: ph.Parameter(a, lower=0, upper=b) for n, (a, b) in TANKS.items()}
    rates = {x: ph.formula(texts[x], **{n: free[n] for n in names[x]}) for x in names}
    return ph.FirstOrder(["h1", "h2"], rates, inputs=["u"])


# --- Bouc and Wen's hysteresis

VELOCITY_ROUNDED, FORCE_ROUNDED = 1e-8, 1e-6  # squares of m/s and N, both negligible


def bouc_wen_physics() -> ph.FirstOrder:
    """m dv/dt = u - c v - k q - z, dz/dt = a v - g |v| z - d v |z|."""
    m, k, c = positive(1.0, "", 0.01), positive(4e4), positive(20.0)
    hysteresis = ph.formula(
        f"a*p/m - g*z*sqrt((p/m)**2 + {VELOCITY_ROUNDED})"
        f" - d*p/m*sqrt(z**2 + {FORCE_ROUNDED})",
        a=positive(3e4),
        g=positive(300.0),
        d=ph.Parameter(0.0),
        m=m,
    )
    force = ph.formula("u - c*p/m - k*q - z", c=c, k=k, m=m)
    rates = {"q": ph.formula("p/m", m=m), "p": force, "z": hysteresis}
    return ph.FirstOrder(["q", "p", "z"], rates, inputs=["u"])


def of_pieces(
    cut: Callable[[ph.Measurements], tuple[ph.Measurements, ph.Measurements]],
) -> Callable[[ph.Model, ph.Measurements], tuple[ph.Model, list[str]]]:
    """By a study of two pieces of the training record."""
    return lambda model, train: found(ph.Study(model, *cut(train)))


def found(study: ph.Study) -> tuple[ph.Model, list[str]]:
    """The model after a study has added what is decisive, and the effects."""
    study.auto()
    return study.model, list(study.history["effect"][1:])


def of_resonance(model: ph.Model, train: ph.Measurements) -> tuple[ph.Model, list[str]]:
    """By a study of the F-16's main resonance; what it adds acts in the joint."""
    held_out = vibrations.resonance(vibrations.JUDGED)
    _, added = found(ph.Study(vibrations.resonance_model(), train, held_out))
    return f16.with_effects(model, added), added


LEAGUE: Mapping[str, Entry] = {
    "EMPS": Entry(
        folder="emps",
        n_first=20,
        unit="mm",
        per_unit=1e3,
        train=partial(emps, "fit"),
        tests=lambda: {"force pulses": emps("test")},
        base=machines.emps_base,
        physics=machines.emps_model,
        study=of_pieces(emps_pieces),
        published="LSTM 74.1 (baseline)",
    ),
    "Silverbox": Entry(
        folder="silverbox",
        n_first=50,
        unit="mV",
        per_unit=1e3,
        train=lambda: box(BOX[0], BOX_LAST),
        tests=lambda: {
            "last 25 % of the multisines": box(BOX_LAST, BOX[1]),
            "arrow": box(*ARROW),
            "arrow without extrapolation": box(*ARROW_NO_EXTRAPOLATION),
        },
        base=machines.box_model,
        physics=box_physics,
        study=of_pieces(partial(machines.first_two, 2 * 2048)),
        published="1.49 and 2.39 (baselines), 0.26 to 0.36 (best)",
    ),
    "cascaded tanks": Entry(
        folder="cascaded_tanks",
        n_first=50,
        unit="V",
        per_unit=1.0,
        train=storages.tanks,
        tests=lambda: {"second record": storages.tanks("Val", most=np.inf)},
        base=storages.textbook_tanks,
        physics=tanks_physics,
        study=of_pieces(lambda data: data.split(storages.TANKS_SHARE)),
        published="0.396 (baseline), 0.18 (grey box)",
        most=storages.FULL,
    ),
    "Bouc-Wen hysteresis": Entry(
        folder="bouc_wen",
        n_first=50,
        unit="um",
        per_unit=1e6,
        train=partial(vibrations.bouc_wen, "est_multisine"),
        tests=lambda: {
            "multisine": vibrations.bouc_wen("val_multisine"),
            "sine sweep": vibrations.bouc_wen("val_sinesweep"),
        },
        base=vibrations.bouc_wen_base,
        physics=bouc_wen_physics,
        study=of_pieces(partial(machines.first_two, vibrations.N_BOUC_WEN)),
        published="about 10",
    ),
    "F-16": Entry(
        folder="f16",
        n_first=50,
        unit="m/s^2",
        per_unit=1.0,
        train=partial(vibrations.resonance, vibrations.FITTED),
        tests=lambda: {f"level {level}": vibrations.f16(level) for level in (2, 4, 6)},
        base=f16.base,
        physics=f16.physics,
        study=of_resonance,
        published="-",
        fit=f16.fitted,
        error=lambda fit, record, entry: f16.error(fit, record, entry.n_first),
    ),
    "industrial robot": Entry(
        folder="industrial_robot",
        n_first=50,
        unit="deg",
        per_unit=1.0,
        train=partial(robot.movements, "train"),
        tests=lambda: {
            "six movements of 60 s": robot.movements("test"),
            "5 s at a time": robot.moving(robot.movements("test"), 99),
        },
        base=partial(robot.joints, is_base=True),
        physics=robot.joints,
        study=robot.study,
        published="23.1 and 16.6 (neural, one run of 363 s)",
        fit=robot.fitted,
        error=lambda fit, record, entry: robot.error(fit, record, entry.n_first),
    ),
}

"""Which terms go: by size, and by significance."""

from typing import Any

import numpy as np
import pytest
from scipy import stats

import phsi_opt as ph
from phsi_opt import Pruning
from tests.systems import pair


def dictionary(degree: int = 2, **slots: Any) -> ph.PseudoHamiltonian:
    return pair(ph.polynomials(["q", "p"], degree), **slots)


MODEL = dictionary(R=ph.damping("p"))
NAMES = list(MODEL.free)
RULE = Pruning(0.0, significance=0.01)


def test_size_alone_knows_nothing_of_errors() -> None:
    found = {**dict.fromkeys(NAMES, 1.0), "H[q]": 0.01, "R_p": 0.001}
    assert Pruning(0.05).small(MODEL, found) == {"H[q]"}  # damping stays by default
    assert Pruning(0.05, slots=("H", "R")).small(MODEL, found) == {"H[q]", "R_p"}
    assert Pruning(0.05).insignificant(MODEL, found, np.eye(len(NAMES)), 6) == set()


def weak_terms(
    values: dict[str, float],
    errors: dict[str, float],
    n_tests: int = 6,
    correlation: float = 0.0,
) -> set[str]:
    """Those that go, of terms with these values and errors among well-known ones."""
    found = dict.fromkeys(NAMES, 1.0) | values
    std_errors = [errors.get(name, 1e-3) for name in NAMES]
    covariance = np.diag(std_errors) ** 2
    i, j = (NAMES.index(name) for name in (*values, *NAMES[-2:])[:2])
    covariance[i, j] = covariance[j, i] = correlation * std_errors[i] * std_errors[j]
    return RULE.insignificant(MODEL, found, covariance, n_tests)


EACH = {n: 0.1 * np.sqrt(stats.chi2.isf(0.01, n) / n) for n in (2, 3)}
ALONE = 0.1 * stats.norm.isf(0.01 / 6 / 2)  # the level over the number of terms
TWO, THREE = ("H[q]", "H[p]"), ("H[q]", "H[p]", "H[q*p]")


@pytest.mark.parametrize(("values", "errors", "options", "gone"), [
    # A term goes where zero explains the data as well; one without an error stays.
    ({"H[q]": 0.3, "H[p]": 0.3}, {"H[q]": 0.2, "H[p]": 0.02}, {}, {"H[q]"}),
    ({"H[q]": 1e-9}, dict.fromkeys(NAMES, np.nan), {}, set()),
    # Each is within its error because the other can stand in for it; not both go.
    ({"H[q]": 0.5, "H[p]": 0.4}, dict.fromkeys(TWO, 0.3), {"correlation": -0.999}, {"H[p]"}),
    ({"H[q]": -0.999 * ALONE}, {"H[q]": 0.1}, {}, {"H[q]"}),
    ({"H[q]": -1.001 * ALONE}, {"H[q]": 0.1}, {}, set()),
    # Three standard errors from zero: more tests make it harder to stay.
    ({"H[q]": 0.3}, {"H[q]": 0.1}, {"n_tests": 1}, set()),
    ({"H[q]": 0.3}, {"H[q]": 0.1}, {"n_tests": 34}, {"H[q]"}),
    # Together they are tested with as many degrees of freedom; the strongest stays.
    (dict.fromkeys(TWO, 0.999 * EACH[2]), dict.fromkeys(TWO, 0.1), {}, set(TWO)),
    ({"H[q]": 1.001 * EACH[2], "H[p]": 1.002 * EACH[2]}, dict.fromkeys(TWO, 0.1), {}, {"H[q]"}),
    (dict.fromkeys(THREE, 0.999 * EACH[3]), dict.fromkeys(THREE, 0.1), {}, set(THREE)),
    (dict.fromkeys(TWO, 1.001 * EACH[3]) | {"H[q*p]": 1.002 * EACH[3]}, dict.fromkeys(THREE, 0.1), {}, set(TWO)),
])  # fmt: skip
def test_terms_go_that_are_not_significant(values, errors, options, gone) -> None:
    assert weak_terms(values, errors, **options) == gone


@pytest.mark.parametrize(("settings", "message"), [
    ({"significance": 0.0}, "between 0 and 1"),
    ({"significance": 5}, "^Pruning: significance=5 .* a number between 0 and 1, such as"),
    ({"significance": 1.0}, "between 0 and 1"),
    ({"significance": "a"}, "significance='a' is not possible; expected float"),
    ({"significance": 0.01, "debias": False}, "^significance needs debias=True: a coefficient that L1 shrinks has no standard error.$"),
    ({"threshold": -1}, "^Pruning: threshold=-1 .* at least 0"),
    ({"threshold": float("nan")}, "at least 0"),
    ({"slots": ("H", "S")}, "^Pruning: slot='S' is not possible; expected one of H, R, F"),
])  # fmt: skip
def test_bad_settings_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ph.ModelError, match=message):
        Pruning(**settings)


def oscillator(seed: int) -> ph.Measurements:
    """Four runs of the undamped oscillator with H = (q^2 + p^2)/2, and noise."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, 10.0, 0.1)
    runs = []
    for _ in range(4):
        size = rng.uniform(1, 2)
        angle = t + rng.uniform(0, 2 * np.pi)
        x = size * np.column_stack([np.cos(angle), -np.sin(angle)])
        runs.append(x + 0.02 * rng.normal(size=(100, 2)))
    return ph.Measurements.from_arrays([t] * 4, runs, states=["q", "p"])


@pytest.mark.parametrize(
    ("model", "said"),
    [(dictionary(), "removes every term;"), (MODEL, "every term of H")],
)
def test_pruning_that_leaves_no_energy_says_so(model: ph.Model, said: str) -> None:
    with pytest.raises(ph.ModelError, match=said):
        ph.identify(model, oscillator(0), ph.PHSILoss(), pruning=Pruning(10.0))


def test_standard_errors_of_the_phsi_loss_are_the_spread_over_many_draws() -> None:
    truth = {"H[q**2]": 0.5, "H[p**2]": 0.5}
    rows = []
    for seed in range(40):
        fit = ph.identify(dictionary(), oscillator(seed), ph.PHSILoss())
        values = [fit.values[name] - truth.get(name, 0.0) for name in fit.names]
        rows.append(values / np.sqrt(np.diag(fit.covariance)))
    z = np.array(rows)
    assert 0.85 < np.sqrt(np.mean((z - z.mean(axis=0)) ** 2)) < 1.15


def test_significance_leaves_the_true_terms_and_no_others_in_nearly_every_draw() -> (
    None
):
    needed = {"H[q**2]", "H[p**2]"}
    kept = []
    for seed in range(20):
        data = oscillator(seed)
        fit = ph.identify(dictionary(3), data, ph.PHSILoss(), pruning=RULE)
        kept.append(set(fit.model.free))
    assert all(needed <= names for names in kept)
    assert kept.count(needed) >= 19

"""Which terms go: by size, and by significance."""

import numpy as np
import pytest
from scipy import stats

import phsi_opt as ph
from phsi_opt.estimation.pruning import Pruning

MODEL = ph.PseudoHamiltonian(
    states=["q", "p"],
    S=ph.canonical(1),
    H=ph.polynomials(["q", "p"], degree=2),
    R=ph.damping("p"),
)
NAMES = list(MODEL.free)


def values(**given: float) -> dict[str, float]:
    return {
        **dict.fromkeys(NAMES, 1.0),
        **{name.replace("_", "["): v for name, v in given.items()},
    }


def test_size_alone_knows_nothing_of_errors() -> None:
    found = {**dict.fromkeys(NAMES, 1.0), "H[q]": 0.01, "R_p": 0.001}
    assert Pruning(0.05).small(MODEL, found) == {"H[q]"}  # damping stays by default
    assert Pruning(0.05, slots=("H", "R")).small(MODEL, found) == {"H[q]", "R_p"}
    assert Pruning(0.05).insignificant(MODEL, found, np.eye(len(NAMES)), 6) == set()


def test_a_term_goes_where_zero_explains_the_data_as_well() -> None:
    found = {**dict.fromkeys(NAMES, 1.0), "H[q]": 0.3, "H[p]": 0.3}
    error = dict.fromkeys(NAMES, 0.01) | {"H[q]": 0.2, "H[p]": 0.02}
    covariance = np.diag([error[name] ** 2 for name in NAMES])
    assert Pruning(0.0, significance=0.01).insignificant(
        MODEL, found, covariance, 6
    ) == {"H[q]"}


def test_two_terms_that_are_needed_together_do_not_both_go() -> None:
    # Each alone is within its error because the other can stand in for it; together
    # they are far from zero.
    found = {**dict.fromkeys(NAMES, 1.0), "H[q]": 0.5, "H[p]": 0.4}
    i, j = NAMES.index("H[q]"), NAMES.index("H[p]")
    covariance = 1e-4 * np.eye(len(NAMES))
    covariance[i, i] = covariance[j, j] = 0.3**2
    covariance[i, j] = covariance[j, i] = -0.999 * 0.3**2
    assert Pruning(0.0, significance=0.01).insignificant(
        MODEL, found, covariance, 6
    ) == {"H[p]"}


def test_a_term_without_a_standard_error_stays() -> None:
    found = {**dict.fromkeys(NAMES, 1.0), "H[q]": 1e-9}
    covariance = np.full((len(NAMES), len(NAMES)), np.nan)
    assert (
        Pruning(0.0, significance=0.01).insignificant(MODEL, found, covariance, 6)
        == set()
    )


def test_more_tests_make_it_harder_to_stay() -> None:
    found = {**dict.fromkeys(NAMES, 1.0), "H[q]": 0.3}
    covariance = np.diag(
        [0.1**2 if name == "H[q]" else 1e-6 for name in NAMES]
    )  # three standard errors from zero
    rule = Pruning(0.0, significance=0.01)
    assert rule.insignificant(MODEL, found, covariance, 1) == set()
    assert rule.insignificant(MODEL, found, covariance, 34) == {"H[q]"}


def weak_terms(z: dict[str, float], significance: float = 0.01) -> set[str]:
    """Those that go, where these terms are so many standard errors from zero."""
    found = dict.fromkeys(NAMES, 1.0) | {
        name: -0.1 * value for name, value in z.items()
    }
    errors = [0.1 if name in z else 1e-3 for name in NAMES]
    rule = Pruning(0.0, significance=significance)
    return rule.insignificant(MODEL, found, np.diag(errors) ** 2, 6)


def test_a_single_term_is_tested_at_the_level_over_the_number_of_terms() -> None:
    limit = stats.norm.isf(0.01 / 6 / 2)
    assert weak_terms({"H[q]": 0.999 * limit}) == {"H[q]"}
    assert weak_terms({"H[q]": 1.001 * limit}) == set()


@pytest.mark.parametrize("n_weak", [2, 3])
def test_terms_that_go_together_are_tested_with_as_many_degrees_of_freedom(
    n_weak: int,
) -> None:
    names = ["H[q]", "H[p]", "H[q*p]"][:n_weak]
    each = np.sqrt(stats.chi2.isf(0.01, n_weak) / n_weak)
    assert weak_terms(dict.fromkeys(names, 0.999 * each)) == set(names)
    # The strongest stays, and the others are within the limit for fewer.
    uneven = dict.fromkeys(names, 1.001 * each) | {names[-1]: 1.002 * each}
    assert weak_terms(uneven) == set(names[:-1])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"significance": 0.0}, "between 0 and 1"),
        ({"significance": 5}, "between 0 and 1"),
        ({"significance": 0.01, "debias": False}, "debias"),
        ({"threshold": -1}, "threshold=-1 .* at least 0"),
        ({"threshold": float("nan")}, "at least 0"),
        ({"slots": ("H", "S")}, "slot='S' is not possible; expected one of H, R, F"),
        ({"significance": 1.0}, "between 0 and 1"),
        ({"significance": "a"}, "between 0 and 1"),
    ],
)
def test_bad_settings_are_refused(settings, message: str) -> None:
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


def test_standard_errors_of_the_phsi_loss_are_the_spread_over_many_draws() -> None:
    model = ph.PseudoHamiltonian(
        states=["q", "p"], S=ph.canonical(1), H=ph.polynomials(["q", "p"], degree=2)
    )
    fits = [ph.identify(model, oscillator(seed), ph.PHSILoss()) for seed in range(40)]
    truth = {"H[q**2]": 0.5, "H[p**2]": 0.5}
    rows = []
    for fit in fits:
        errors = {name: fit.values[name] - truth.get(name, 0.0) for name in fit.names}
        rows.append([errors[name] / fit.std_errors[name] for name in fit.names])
    z = np.array(rows)
    assert 0.85 < np.sqrt(np.mean((z - z.mean(axis=0)) ** 2)) < 1.15


def test_pruning_that_leaves_no_energy_says_so() -> None:
    model = ph.PseudoHamiltonian(
        states=["q", "p"], S=ph.canonical(1), H=ph.polynomials(["q", "p"], degree=2)
    )
    with pytest.raises(ph.ModelError, match="removes every term"):
        ph.identify(model, oscillator(0), ph.PHSILoss(), pruning=Pruning(10.0))
    damped = ph.PseudoHamiltonian(
        states=["q", "p"],
        S=ph.canonical(1),
        H=ph.polynomials(["q", "p"], degree=2),
        R=ph.damping("p"),
    )
    with pytest.raises(ph.ModelError, match="every term of H"):
        ph.identify(damped, oscillator(0), ph.PHSILoss(), pruning=Pruning(10.0))


def test_significance_leaves_the_true_terms_and_no_others_in_nearly_every_draw() -> (
    None
):
    model = ph.PseudoHamiltonian(
        states=["q", "p"], S=ph.canonical(1), H=ph.polynomials(["q", "p"], degree=3)
    )
    kept = [
        set(
            ph.identify(
                model,
                oscillator(s),
                ph.PHSILoss(),
                pruning=Pruning(0.0, significance=0.01),
            ).model.free
        )
        for s in range(20)
    ]
    assert all({"H[q**2]", "H[p**2]"} <= names for names in kept)
    assert sum(names == {"H[q**2]", "H[p**2]"} for names in kept) >= 19

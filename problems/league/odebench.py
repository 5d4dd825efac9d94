"""ODEBench less one term: does a study find what was taken out of an equation?

    python -m problems.league.odebench [NUMBER ...] [--download] [--data=FOLDER]
        [--noise=0,0.05] [--seed=36000] [--jobs=N]

The last additive term of the first equation that has two or more is taken out, products
multiplied out; where no equation has two, the last equation is emptied. Systems that
are named are run and printed; without numbers all are, and the page is written. Each
result is kept as it comes, in results/league/COMMIT. ``--download`` fetches the file.
"""

import ast
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import numpy as np
import pandas as pd
from scipy.signal import savgol_filter

import phsi_opt as ph
from phsi_opt.model.expressions import NUMPY, evaluate, names_of, parse
from phsi_opt.model.symbolic import is_redundant
from phsi_opt.model.terms import Dictionary, Term
from phsi_opt.writing import write_whole
from problems.tools import provenance
from problems.tools.command_line import chosen, flag, option
from problems.tools.data_paths import folder, is_present
from problems.tools.pages import render
from problems.tools.workers import computed

Array = np.ndarray
Result = dict[str, Any]
FILE = "strogatz_extended.json"
SOURCE = (
    "https://raw.githubusercontent.com/sdascoli/odeformer/"
    f"32dd990839ae9af0049023dcc20a640732fe2050/odeformer/odebench/{FILE}"
)
START_OFF = 1.2  # constants start at this times their value
TRAINED = 0.7  # share of the solution that is fitted where the rest is held out
ACCURATE = 0.9  # R^2 beyond which a run is accurate, as ODEBench counts
DEGREE = 3  # of the products of states
# Share of a term (sum of squares along both solutions) that an effect explains if it is
# the same law; values of its inner number that are tried, over the typical state.
SAME_LAW = 0.9999
INNER = np.geomspace(0.1, 10.0, 200)
WAYS = ("rest of the model", "study", "all terms given", "pysindy")
RUNS = ("reconstruction", "generalization")
FAILED = [-np.inf, -np.inf]  # R^2 of both runs
# SINDy: samples that are smoothed over, thresholds, and dictionaries: the degree of the
# polynomials, and waves of each state.
WINDOWS, THRESHOLDS = (7, 15, 31, 61), (0.02, 0.05, 0.1, 0.2, 0.5)
TERMS = ((2, ()), (3, ()), (3, ("sin", "cos")))
N_AGAIN = 5  # settings that are fitted to the whole solution too


@dataclass(frozen=True)
class System:
    """A system: right-hand sides and constants by name, and its two solutions."""

    number: int
    title: str
    rates: Mapping[str, str]
    constants: Mapping[str, float]
    t: Array
    runs: tuple[Array, ...]  # (n_samples, n_states) each

    def model(self, rates: Mapping[str, str]) -> ph.FirstOrder:
        """These rates with the constants to be found."""
        free = {n: ph.Parameter(START_OFF * c) for n, c in self.constants.items()}
        terms = {}
        for state, text in rates.items():
            used = {name: free[name] for name in names_of(text) & set(free)}
            terms[state] = ph.formula(text, **used)
        return ph.FirstOrder(list(rates), terms)

    def less_one_term(self) -> tuple[dict[str, str], str, str]:
        """The rates without a term, its equation, and the term."""
        terms = {x: terms_of(parse(text)) for x, text in self.rates.items()}
        several = [x for x, found in terms.items() if len(found) > 1]
        equation = (several or list(terms)[-1:])[0]
        *rest, last = map(ast.unparse, terms[equation])
        return {**self.rates, equation: " + ".join(rest) or "0"}, equation, last

    def r2(self, simulate: Callable[[Array, Array], Array]) -> list[float]:
        """R^2 of free runs from where the solutions begin."""
        try:
            return [r2(run, simulate(self.t, run[0])) for run in self.runs]
        except ph.PhsiOptError:  # the states grow without bound
            return FAILED


def r2(true: Array, simulated: Array) -> float:
    """1 - squared error over variance, each summed over the states."""
    variance = np.sum((true - true.mean(axis=0)) ** 2)
    return 1 - float(np.sum((simulated - true) ** 2) / variance)


def terms_of(node: ast.expr) -> list[ast.expr]:
    """The terms of a sum, in their order; products of sums are multiplied out."""
    match node:
        case ast.BinOp(left=a, op=ast.Add(), right=b):
            return terms_of(a) + terms_of(b)
        case ast.BinOp(left=a, op=ast.Sub(), right=b):
            return terms_of(a) + terms_of(ast.UnaryOp(ast.USub(), b))
        case ast.BinOp(left=a, op=ast.Mult() as times, right=b):
            pairs = product(terms_of(a), terms_of(b))
            return [ast.BinOp(one, times, other) for one, other in pairs]
        case ast.BinOp(left=a, op=ast.Div() as over, right=b):
            return [ast.BinOp(one, over, b) for one in terms_of(a)]
        case ast.UnaryOp(op=ast.USub() as minus, operand=a):
            return [ast.UnaryOp(minus, one) for one in terms_of(a)]
    return [node]


def read(path: Path) -> dict[int, System]:
    """The systems of the published file, which is data: no text of it is executed."""
    found = {}
    for one in json.loads(path.read_text("utf-8")):
        text = one["eq"].replace("^", "**").replace("cot(", "1/tan(")
        rates = {f"x_{k}": rate.strip() for k, rate in enumerate(text.split("|"))}
        constants = {f"c_{k}": value for k, value in enumerate(one["consts"][0])}
        runs = [np.array(solution["y"]).T for solution in one["solutions"][0]]
        t = np.array(one["solutions"][0][0]["t"])
        known = (one["id"], one["eq_description"], rates, constants, t, tuple(runs))
        found[one["id"]] = System(*known)
    return found


def effects(model: ph.FirstOrder) -> list[ph.Effect]:
    """The catalogue and products of states; errors of sensors last."""
    found = list(ph.catalogue(model))
    for state, term in product(model.states, ph.polynomials(model.states, DEGREE)):
        effect = ph.Effect(f"product {term.body}", "F", state, Dictionary((term,)))
        found += [] if is_redundant(model, effect) else [effect]
    return sorted(found, key=lambda one: one.slot == "sensor")


def is_law(effect: ph.Effect, system: System, equation: str, text: str) -> bool:
    """Whether an effect can be this term along both solutions."""
    (term, *others), is_sensor = effect.term, effect.slot == "sensor"
    if effect.equation != equation or others or effect.memory or effect.needs_clock:
        return False
    if is_sensor or term.coefficient is None:
        return False
    along = dict(zip(system.rates, np.vstack(system.runs).T, strict=True))
    missing = 0 * along[equation] + evaluate(text, {**along, **system.constants}, NUMPY)
    shape = -along[equation] if effect.slot == "R" else 1 + 0 * along[equation]
    typical = np.sqrt(np.mean(along[equation] ** 2))
    is_free = any(not one.fixed for one in term.inner.values())
    for inner in INNER if is_free else (1e-6,):
        given = along | dict.fromkeys(term.inner, inner * typical)
        rate = shape * evaluate(term.body, given, NUMPY)
        size = float(rate @ missing)
        is_same = size**2 > SAME_LAW * (rate @ rate) * (missing @ missing)
        if is_same and (size > 0 or term.coefficient.lower < 0):
            return True
    return False


def studied(case: tuple[str, int, float, int]) -> Result:
    """What a study finds of the term that is missing, and R^2 of both runs by way."""
    path, number, noise, seed = case
    began = time.process_time()
    system = read(Path(path))[number]
    rng = np.random.default_rng([seed, number])
    x = system.runs[0] * (1 + noise * rng.standard_normal(system.runs[0].shape))
    data = ph.Measurements.from_arrays(system.t, x, states=list(system.rates))
    rates, equation, term = system.less_one_term()
    base = system.model(rates)
    candidates = {str(one): one for one in effects(base)}
    laws = {n for n, one in candidates.items() if is_law(one, system, equation, term)}
    holder = "products" if laws else "neither"
    if any(not name.startswith("product") for name in laws):
        holder = "catalogue"
    begin = time.process_time()
    outcome, added, ended, model = "not fitted", [], "", None
    try:
        study = ph.Study(base, *data.split(TRAINED), effects=list(candidates.values()))
        first = study.diagnose()
        ended, model = study.auto(), study.model
        added = list(map(str, study.added))
        outcome = str(first.verdict)
        if added:
            alike = first.candidates["confusable_with"].iloc[0].split(", ")
            outcome = "in its class" if laws & set(alike) else "another law"
        if laws & set(added):
            outcome = "named" if len(added) == 1 else "named with others"
    except ph.SolveError as error:
        ended = str(error)
    seconds = time.process_time() - begin
    models = (base, model, system.model(system.rates))
    scores = [score(system, data, one) for one in models] + [by_sindy(system, data)]
    told = {"number": number, "system": system.title, "states": len(rates)}
    told |= {"noise": noise, "term": f"d{equation}/dt: {term}", "holder": holder}
    told |= {"outcome": outcome, "added": ", ".join(added), "ended": ended}
    told |= {"seconds": seconds, "all seconds": time.process_time() - began}
    return told | dict(zip(WAYS, scores, strict=True))


def score(system: System, data: ph.Measurements, model: ph.Model | None) -> list[float]:
    """R^2 of a model whose numbers are those of the whole first solution."""
    try:
        fit = None if model is None else ph.identify(model, data)
    except ph.SolveError:
        fit = None
    return system.r2(fit.simulate) if fit else FAILED


def by_sindy(system: System, data: ph.Measurements) -> list[float]:
    """R^2 of SINDy with the best of the settings that do well where 70 % are fitted."""
    from problems.peers.sindy import sindy

    states = data.states

    def simulated(
        of: ph.Measurements, setting: tuple[Any, ...], t: Array, start: Array
    ) -> Array:
        window, threshold, (degree, waves) = setting
        terms = ph.polynomials(states, degree, constant=True)
        for wave, state in product(waves, states):
            terms += Dictionary((Term(f"{wave}({state})", ph.Parameter()),))
        (run,) = of.trajectories
        x = savgol_filter(run.x, window, 3, axis=0)
        smooth = ph.Measurements.from_arrays(run.t, x, states=states)
        model = ph.FirstOrder(states, dict.fromkeys(states, terms))
        return sindy(model, smooth, threshold=threshold).simulate(t, start)

    noisy = replace(system, runs=(data.trajectories[0].x,))
    train = data.split(TRAINED)[0]
    settings = list(product(WINDOWS, THRESHOLDS, TERMS))
    for of, n_left in ((train, N_AGAIN), (data, 1)):
        settings.sort(key=lambda one: noisy.r2(partial(simulated, of, one)))
        settings = settings[-n_left:]
    return system.r2(partial(simulated, data, settings[0]))


def page(results: Sequence[Result], seed: int) -> str:
    """Counts by noise, by who holds the term and by states; a row per system."""
    frame = pd.DataFrame(results).sort_values(["noise", "number"])
    runs = frame.melt(["noise", "states"], list(WAYS), "way", "r2").explode("r2")
    runs["run"] = RUNS * (len(runs) // 2)
    runs["n"] = runs["r2"] > ACCURATE
    counted = partial(pd.pivot_table, values="n", columns="way", aggfunc="sum")
    generalized = runs[runs["run"] == RUNS[1]]
    by = [frame["noise"], frame["holder"]]
    outcomes = pd.crosstab(by, frame["outcome"], margins=True, margins_name="n")
    for way in WAYS:
        frame[way] = frame[way].str[1].map("{:.3g}".format)
    frame["seconds"] = frame["seconds"].round(1)
    told = ["noise", "number", "system", "term", "holder", "outcome", "added"]
    return render(
        "league/pages/odebench.md",
        seed=seed,
        ways=WAYS,
        n=frame["number"].nunique(),
        accurate=counted(runs, index=["noise", "run"])[[*WAYS]].reset_index(),
        states=counted(generalized, index=["noise", "states"])[[*WAYS]].reset_index(),
        sizes=frame.drop_duplicates("number")["states"].value_counts().sort_index(),
        seconds=frame["seconds"],
        outcomes=outcomes.reset_index(),
        systems=frame[[*told, *WAYS, "seconds"]],
    )


def main() -> None:
    """Run the systems, print each result, write the page."""
    path = folder("odebench") / FILE
    if flag("download"):
        path.parent.mkdir(parents=True, exist_ok=True)
        with urlopen(option("source", SOURCE), timeout=60) as answer:
            write_whole(path, answer.read().decode("utf-8"))
    if not is_present(path):
        return
    seed = int(option("seed", "36000"))
    numbers = list(map(int, chosen())) or list(read(path))
    cases = {}
    for noise, number in product(option("noise", "0,0.05").split(","), numbers):
        key = f"odebench {number}, noise {noise}, seed {seed}"
        cases[key] = (str(path), number, float(noise), seed)
    kept = provenance.RESULTS / "league" / provenance.commit()
    done: dict[str, Result] = {}
    for one in computed(studied, cases, folder=kept):
        done[one.key] = one.result
        print(json.dumps(one.result), flush=True)
    if not chosen():
        results = list(done.values())
        seconds = sum(result["all seconds"] for result in results)
        provenance.write("odebench.md", page(results, seed), seconds=seconds)


if __name__ == "__main__":
    main()

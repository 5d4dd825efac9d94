"""The HTML report: what it says and in which order, and that nothing can be injected."""

import base64
import gzip
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import matplotlib

matplotlib.use("Agg")
import numpy as np
import pandas as pd
import pytest

import phsi_opt as ph
from phsi_opt.errors import some_of
from phsi_opt.force_analysis.analysis import advice_of_cause
from phsi_opt.force_analysis.dependence import Causes
from phsi_opt.presentation.charts import (
    Chart,
    Curve,
    Panel,
    drawn,
    errors_chart,
    follows_chart,
    rounded,
    run_chart,
    svg,
)
from phsi_opt.presentation.content import (
    GOOD,
    LOOK,
    SEVERITY_WORDS,
    Answer,
    Channel,
    ErrorStep,
    Ranked,
    Run,
    StudyContent,
    thinned,
)
from phsi_opt.presentation.html_report import html_report, markdown_report
from phsi_opt.presentation.numbers import (
    estimate_text,
    number,
    p_value_words,
    percent,
    proper_names,
    range_words,
    said,
    short_constants,
    typeset,
    unbroken,
    with_error,
    with_interval,
)
from phsi_opt.presentation.units import rate_unit, times_words
from phsi_opt.screening.effect_size import Size
from phsi_opt.study.answers import summary_of
from phsi_opt.study.content import study_content
from phsi_opt.study.record import StudyRecord
from problems.examples.demo import model as spring
from problems.examples.friction_spring import table

MOST_BYTES = 1_500_000
ORDER = ["verdict", "runs", "errors", "data", "equations", "where", "ranked", "checks"]
HOSTILE = "</script><script>alert(1)</script><img src=x onerror=alert(2)>$\\x$ {{7*7}}"


def measurements(runs: int, friction: float = 2.0) -> ph.Measurements:
    frame = table(5, friction)
    kept = frame[frame["run"].isin([f"run {i + 1}" for i in range(runs)])]
    return ph.Measurements.from_dataframe(
        kept,
        time="t_s",
        states={"q": "position_m", "p": None},
        trajectory="run",
        units={"q": "m", "p": "kg m/s", "t": "s"},
    )


@pytest.fixture(scope="module")
def study() -> ph.Study:
    found = ph.Study(
        spring(), *measurements(4).split(0.5), effects=["coulomb friction"]
    )
    found.auto()
    return found


@pytest.fixture(scope="module")
def content(study: ph.Study) -> StudyContent:
    return study_content(study.record)


@pytest.fixture(scope="module")
def page(study: ph.Study, tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("report") / "report.html"
    assert study.report(path) == path
    return path.read_text(encoding="utf-8")


class Reader(HTMLParser):
    """Elements and texts of a page, as a browser would see them."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.scripts: list[str] = []
        self.text = ""
        self._inside = ""
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        self._inside = tag

    def handle_endtag(self, tag: str) -> None:
        self._inside = ""

    def handle_data(self, data: str) -> None:
        if self._inside == "script":
            self.scripts.append(data)
        elif self._inside != "style":
            self.text += data

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.elements if name == tag]


def with_diagnoses(study: ph.Study, *diagnoses: ph.Diagnosis) -> StudyRecord:
    """The study with as many steps as there are diagnoses of them."""
    record = study.record
    found = dict(enumerate(diagnoses))
    return replace(
        record, steps=record.steps[: len(found)], diagnoses=found, stopped=""
    )


def unexplained(diagnosis: ph.Diagnosis, **changes: Any) -> ph.Diagnosis:
    """The same of a catalogue that has no name for what is missing."""
    left = {"findings": (), "proposed": (), "reason": "none", **changes}
    return replace(diagnosis, verdict=ph.Verdict.UNEXPLAINED, **left)


def test_a_diagnosis_says_what_where_when_and_what_to_do(content, study) -> None:
    expected = {
        "Verdict": r"Found\. Coulomb friction in the equation of p \([\d.]+ \+- [\d.]+ N\); the held-out "
        r"error falls from .*",
        "What is wrong": r"The model has an error of 0\.\d+ m in position .* equation of p lacks a "
        r"force of [\d.]+ N \(rms\), [\d.]+ times its standard deviation and .*",
        "Where": r"In the equation of p\.",
        "When": r"Significant in \d+ % of the record, in both "
        r"training runs; mostly at [\d.]+ Hz\. It is strongest at t = .* of run \d\..*",
        "What to do next": r"Add coulomb friction in the equation of p\. In Python, study\.add .*",
    }
    answers = {one.question: str(one) for one in content.diagnoses[0].answers}
    assert list(answers) == list(expected)
    for question, pattern in expected.items():
        assert re.fullmatch(pattern, answers[question]), answers[question]


def test_the_first_screen_says_what_was_found_how_sure_and_how_good(
    content, study
) -> None:
    found = content.headline.discovery
    assert re.fullmatch(
        r"Coulomb friction \([\d.]+ ± [\d.]+ N\) was missing\.", found.lead
    )
    assert re.fullmatch(
        r"With it, the error on data not used for fitting fell from ([\d.]+) to [\d.]+ m, "
        r"the size of the noise\. The data show nothing more that is missing\.",
        found.detail,
    )
    answers = {one.question: one for one in content.headline.answers}
    assert answers["Verdict"].lead == "Nothing missing."
    assert "What is wrong" not in answers
    assert answers["How sure is it"].lead == (
        "Practically certain (odds of more than a million to one)."
    )
    assert re.fullmatch(
        r"Simulated freely for up to [\d.]+ s, it stays within [\d.]+ m \(rms\) of the "
        r"measured position: the size of the noise\.",
        answers["How good is the model"].lead,
    )
    covered = r"The data cover position from -[\d.]+ to [\d.]+ m; measure again .*"
    said = answers["What to do next"].detail
    assert re.fullmatch(covered, said)
    ends = [float(one) for one in re.findall(r"-?[\d.]+(?= to| m;)", said)]
    parts = (study.record.train, study.record.held_out)
    values = np.concatenate([run.x[:, 0] for part in parts for run in part])
    assert ends == pytest.approx([np.nanmin(values), np.nanmax(values)], rel=0.1)


def test_a_table_tells_which_effect_was_accepted_and_the_grade_of_no_other(
    study, content, page
) -> None:
    first, last = content.diagnoses
    (named,) = first.ranking
    assert named.row("m")["Result"] == "accepted"
    assert named.evidence.startswith("decisive, log evidence")
    (candidate,) = study.record.diagnoses[0].ranking
    rejected = replace(candidate, lost="its size ends at a bound")
    diagnosis = unexplained(study.record.diagnoses[0], ranking=(rejected,))
    (row,) = study_content(with_diagnoses(study, diagnosis)).diagnoses[0].ranking
    assert row.lost == "its size ends at a bound" and not row.odds
    assert re.fullmatch(r"log evidence \d+", row.evidence)
    assert not last.ranking or last.ranking[0].lost
    assert "Result" in page and "Rejected because" not in page


def test_what_is_not_proven_is_told_with_the_reason_and_without_a_grade(study) -> None:
    (candidate,) = study.record.diagnoses[0].ranking
    lost = "it explains only 3 % of what is missing (mean square)"
    ranking = (replace(candidate, lost=lost),)
    diagnosis = unexplained(study.record.diagnoses[0], ranking=ranking)
    content = study_content(with_diagnoses(study, diagnosis))
    said = " ".join(one.told for one in content.headline.answers)
    assert "it explains only" not in said
    assert "decisive" not in said and "log evidence" not in said


def test_a_part_that_failed_before_is_told_in_the_past(study, content, page) -> None:
    assert content.where == "Where the base model failed"
    assert "Where it fails" not in page and "missing: named" not in page
    assert "Base model: found" in Reader(page).text
    found = unexplained(study.record.diagnoses[0])
    open_ = study_content(with_diagnoses(study, found))
    assert open_.where == "Where it fails"
    assert open_.headline.status == "missing: unexplained"  # for programs
    assert ": cause unknown</title>" in html_report(open_)
    assert ": cause unknown" in markdown_report(open_).splitlines()[0]
    silent = study.record.diagnoses[1]
    alone = study_content(with_diagnoses(study, silent))
    assert alone.where == "Diagnosis"
    assert alone.headline.sentence == "Nothing is missing."
    assert "How sure is it" not in [one.question for one in alone.headline.answers]


def test_what_the_data_do_not_distinguish_is_the_next_step(study) -> None:
    named, silent = study.record.diagnoses.values()
    (finding,) = named.findings
    other = replace(finding.effects[0], name="stribeck friction")
    of_class = replace(finding, effects=(finding.effects[0], other))
    found = replace(named, findings=(of_class,))
    headline = study_content(with_diagnoses(study, found, silent)).headline
    assert headline.answers[0].lead == "Nothing missing."
    assert headline.next_step.lead == (
        "Distinguish coulomb friction in the equation of p from stribeck friction in "
        "the equation of p by an experiment."
    )
    assert headline.next_step.detail.startswith("Until then, use the model. The data")


def test_calls_and_sums_are_in_the_folded_part_alone(study, page) -> None:
    before, _, folded = page.partition("Data, settings, versions and calls")
    for word in ("SHA-256", "MaximumLikelihood", "study.add", "a local optimum was"):
        assert word not in before and word in folded, word
    (left,) = re.findall(r"<h2 id=.settings-heading.*?<details>", page, re.S)
    assert "<dt>" not in left


def test_what_is_not_established_is_not_said_to_be_what_was_lacking(study) -> None:
    named, silent = study.record.diagnoses.values()
    open_ = unexplained(named)
    headline = study_content(with_diagnoses(study, open_, open_)).headline
    assert re.match(
        r"Added, but not established: coulomb friction \([\d.]+ ± [\d.]+ N\)\. With it, the "
        r"error on data not used for fitting fell from",
        headline.sentence,
    )
    assert (
        "What remains: a force is missing; the only effect tried" in headline.sentence
    )
    answers = {fact.question: fact.detail for fact in headline.answers}
    assert "The equation of p lacks a force of" in answers["What is wrong"]
    assert "What to do next" in answers

    assert silent.verdict == ph.Verdict.NOTHING_MISSING
    record = with_diagnoses(study, open_, silent)
    assert [one.name for one in record.unestablished] == ["coulomb friction on p"]
    headline = study_content(record).headline
    assert headline.sentence.endswith(
        "There is no evidence that anything is missing from the present model."
    )
    assert headline.answers[0].severity == LOOK
    said = "added, but not established: coulomb friction in the equation of p"
    assert said in str(summary_of(record).parts[-1].text)
    assert said in markdown_report(study_content(record))
    assert study_content(study.record).headline.answers[0].severity == GOOD
    assert not study.record.unestablished


def test_the_first_screen_of_an_unexplained_misfit_says_what_to_do(study) -> None:
    unknown = unexplained(study.record.diagnoses[0])
    content = study_content(with_diagnoses(study, unknown))
    headline = content.headline
    tried = r"(none of the \d+ effects tried explains|the only effect tried does not)"
    assert re.match(f"A force is missing; {tried}", headline.sentence)
    answers = {one.question: one.told for one in headline.answers}
    assert answers["Where"].startswith("In the force on position (the equation of p)")
    assert re.match(
        r"Simulated freely for up to 5 s, it stays within 0\.\d+ m \(rms\) of the measured "
        r"position, [\d.]+ times the noise\. On data not used for fitting; the initial state of "
        r"each run is estimated from the whole run; the noise is [\d.]+ m\. In the worst of its 2 runs "
        r"\(run \d\), 0\.\d+ m\.",
        answers["How good is the model"],
    )
    wrong = answers["What is wrong"]
    # One scale for error and noise, in numbers that can be compared.
    assert re.search(
        r"0\.\d+ m in position \(\d+ % of its standard deviation; noise alone \d+ %\)",
        wrong,
    )
    assert re.search(
        r"The equation of p lacks a force of [\d.]+ N \(rms\), .* % of the net force in the model",
        wrong,
    )
    assert wrong.startswith("The model has an error of 0.")
    assert "Simulated on data not used for fitting." in wrong
    assert "times the noise" not in wrong
    assert "dH_d" not in " ".join(answers.values())
    do = answers["What to do next"]
    assert "No effect of the catalogue explains what is missing." in do
    # The pair predicts a tenth better than p alone, give or take.
    assert re.search(
        r"your own term to the equation of p, as a function of (position and )?p\.", do
    )
    (diagnosed,) = content.diagnoses
    assert headline.answers[: len(diagnosed.answers)] == diagnosed.answers


@pytest.mark.parametrize(("shares", "kind", "variable", "expected"), [
    ({}, "thermal", "p", "a further heat storage"),
    ({}, "", "p", "a further moving part (backlash"),
    ({"parameters": 0.8}, "electrical", "p", "Fit each half of the record separately"),
    ({"parameters": 0.8}, "electrical", "p", "second resistor and capacitor"),
    ({"inputs": 0.8}, "", "p", "Measure the force on p directly, or add"),
    ({"time": 0.8}, "", "p", "Repeat the run"),
    ({"dissipated": 0.4}, "", "p", "is not a function of the quantities measured"),
    ({"conserved": 0.8}, "", "q", "as a function of q."),
    ({"conserved": 0.8}, "", "q, p", "as a function of q and p."),
    ({"conserved": 0.8}, "", "dH_dp", "as a function of p."),
])  # fmt: skip
def test_what_to_do_follows_from_what_the_force_looks_like(
    shares: dict[str, float], kind: str, variable: str, expected: str
) -> None:
    kinds = dict.fromkeys(("q", "p"), kind) if kind == "electrical" else {}
    model: ph.Model = replace(spring(), inputs=("u",), kind=kinds)
    if kind == "thermal":
        model = ph.FirstOrder(["p"], {"p": ph.formula("-a*p", a=1.0)}, kind=kind)
    row = {"equation": ["p"], "variable": [variable], "share": [0.93]}
    force: Any = SimpleNamespace(
        wave=None,
        equation="p",
        causes=Causes(shares),
        row=model.states.index("p"),
        variable_words=str,
        equation_words="the equation of p",
        record=SimpleNamespace(model=model, units={}, labels={}),
        follows=pd.DataFrame(row),
    )
    assert expected in str(advice_of_cause(force))


def test_digits_stop_where_they_say_nothing() -> None:
    assert p_value_words(6.8e-292) == "below 1e-06"
    assert p_value_words(0.034) == "0.034"
    assert some_of("abcde") == "a, b, c, d, e" and some_of("", "nothing") == "nothing"
    assert some_of(["a" * 50] * 4) == f"{'a' * 50}, {'a' * 50} and 2 more"
    assert estimate_text(39.9871, 0.104) == "39.99 +- 0.10"
    assert estimate_text(0.00402, 0.006) == "0.0040 +- 0.0060"
    assert estimate_text(-3.8e-5, 0.0032) == "0.0000 +- 0.0032"
    assert estimate_text(1.2345e-6, 4.2e-8) == "(1.235 +- 0.042)e-06"
    assert estimate_text(2.5, np.nan) == "2.5"
    assert estimate_text(263.3, 1895.4) == "300 +- 1900"
    assert estimate_text(1.77184e-4, 1.3e-8, "1/s") == "(1.77184 +- 0.00013)e-04 per s"
    assert estimate_text(0.019967, 7.7e-5, "1/rad") == "0.01997 +- 0.00008 per rad"
    assert estimate_text(0.0053, 4.2e-6, "s") == "5.3000 +- 0.0042 ms"
    assert estimate_text(2e9, 3e6, "N/m") == "2.0000 +- 0.0030 GN/m"
    assert estimate_text(2e9, 3e6, "kg m^2") == "(2.0000 +- 0.0030)e+09 kg m^2"
    assert estimate_text(8.4999812, 7.1e-6) == "8.4999812 +- 0.0000071"
    assert with_error(2e9, 3e6, "m^2") == "(2.0000 ± 0.0030)×10⁹ m²"
    assert str(Size(4000.0, 52000.0)) == "size not determined"
    assert str(Size(146.32, np.nan, "mm")) == "146.3 mm"
    assert str(Size(np.nan, np.nan, "mm")) == "size not determined"
    assert with_error(-49.2, 11.9) == "\N{MINUS SIGN}49 ± 12"
    assert with_error(2.5, np.nan) == "2.5" and number(None) == "not known"
    assert number(0.04, 3) == "0.0400" and number(0.0, 3) == "0" and number(4.0) == "4"
    assert with_interval(0.04, (0.035, 0.0448)) == "0.0400 (95 %: 0.0350 to 0.0448)"
    shares = (0.93, 0.9967, 0.99996, 1.0, 0.0)
    assert [*map(percent, shares)] == ["93", "99.7", "99.996", "100", "0"]
    assert number(2.6e2, 2) == "260" and number(748.6, 2) == "750"
    assert number(2.79e-6, 3) == "2.79×10⁻⁶" and number(3.1e9, 2) == "3.1×10⁹"
    assert said("a floor of 2.79e-06 m, run_1e5") == "a floor of 2.79×10⁻⁶ m, run_1e5"
    assert range_words(-0.0312, -1.47e-5) == "-0.0312 to 0"
    assert range_words(15.04, 24.1, "m") == "15.04 to 24.10 m"
    for text, kept in {
        "Friction, 0.147 ± 0.005 N m, was": "Friction, 0.147~±~0.005~N~m, was",
        "0.25 ± 0.01 1/(°C h) and 3.2×10⁻⁹ ± 1×10⁻⁹ K/s²": "0.25~±~0.01~1/(°C~h) and "
        "3.2×10⁻⁹~±~1×10⁻⁹~K/s²",
        "0.1 ± 0.2 N m s/rad": "0.1~±~0.2 N~m~s/rad",
        "from 1 to 2 °C in 3 runs, 2 models": "from 1 to 2~°C in 3 runs, 2 models",
    }.items():
        assert unbroken(text) == kept.replace("~", "\N{NO-BREAK SPACE}")
    assert range_words(0, 0) == "0 to 0"
    assert short_constants("(0.00474972 m/s)**4") == "(0.00475 m/s)**4"
    kept = "(0.123456 +- 0.000012 N) + 9.81*x"
    assert short_constants(kept) == kept
    assert typeset("714 rad/s^2, 3 +- 1 kg m^2") == "714 rad/s², 3 ± 1 kg m²"
    assert typeset("1/(%^2 s^2)") == "1/(%² s²)"
    assert typeset("k*q**2/2 + x^n + 2^3") == "k*q**2/2 + x^n + 2^3"
    assert proper_names("+ coulomb friction on p") == "+ Coulomb friction on p"
    code = "study.add('coulomb friction', 'p'); coulomb_friction_p.v0"
    assert said(code) == code
    shown = rounded(np.array([1000.12345678, np.nan, 1e3 + 1]))
    assert shown == [1000.1234568, None, 1001.0]
    assert rounded(np.zeros(2)) == [0.0, 0.0]


def test_a_picture_for_paper_has_plain_numbers_and_no_zero_far_from_its_curves() -> (
    None
):
    steps = [
        ErrorStep("base model", 1.5, None, 0.05),
        ErrorStep("one", 0.05, None, 0.05),
    ]
    errors = errors_chart(steps, "m")
    assert "mathdefault" not in svg(errors)
    assert errors.panels[0].label == "error, on a log scale (m)"
    assert errors.panels[0].curves[-1].group == "noise floor 0.0500"
    near = errors_chart([ErrorStep("a", 2, 1.9, 1), ErrorStep("b", 1, 1.1, 1)], "degC")
    train, held_out, floor = near.panels[0].curves
    assert floor.band == "noise floor of held-out data 1.00"
    assert train.is_below == (False, True)
    assert held_out.is_below == (True, False)
    t = np.linspace(0.0, 1.0, 9)
    warm = Chart("t", (Panel("T", (Curve("T", t, 30 + t, "C0"),)),))
    assert drawn(warm).get_ylim()[0] > 20


@pytest.mark.parametrize(("times", "unit", "said"), [
    ((261, 314), "h", "10.9 to 13.1 days"),
    ((2, 3), "h", "2 to 3 h"),
    ((100, 300), "min", "1.67 to 5 h"),
    ((0.197, 0.39), "s", "0.197 to 0.39 s"),
    ((7.93e5, 1.06e6), "ms", "793000 to 1.06e+06 ms"),
    ((0, 1.5e4), "s", "0 to 4.17 h"),
    ((4, 5), "", "4 to 5"),
])  # fmt: skip
def test_long_times_are_told_in_hours_and_days(times, unit, said) -> None:
    assert times_words(times[0], times[1], unit) == said


def test_verdict_table_and_picture_use_the_same_words(page, content, study) -> None:
    text = Reader(page).text
    verdict = str(study.diagnose().verdict)
    assert content.headline.status == verdict
    assert f"<title>Study of position (m): {verdict}</title>" in page
    for step in content.steps:
        assert proper_names(step.label) in text
    assert (
        "coulomb friction"
        not in text.split("Reproduce this result")[1].split("Seeds")[0]
    )
    last = study.history.iloc[-1]
    assert f"{last['held_out_rmse']:.3g}" in text and number(last["bic"], 6) in text
    held_out = [step.held_out for step in content.steps]
    assert held_out == list(study.history["held_out_rmse"])
    items = re.findall(r'<li class="(good|look|bad)"><span class="word">(.*?)<', page)
    assert len(items) == len(content.checks) > 0
    assert all(SEVERITY_WORDS[severity] == word for severity, word in items)
    (day,) = re.findall(
        r"2 runs for fitting and 2 for testing \(held out\); report of ([\d-]+)<", page
    )
    again = study_content(study.record, study.record.laws(), written=day)
    assert html_report(again, study.record.data_chart()) == page
    lines = markdown_report(again).splitlines()
    (head,) = [k for k, line in enumerate(lines) if line.startswith("| Step | Model |")]
    assert lines[head + 1].startswith("| --- | --- |")
    assert lines[head + 2].startswith("| 0 | base model | 0.0")
    assert any(line.endswith(" | accepted |") for line in lines)
    titled = replace(study.record, title="Drive <7>")
    assert "<title>Drive &lt;7&gt;: " in html_report(study_content(titled))


def test_the_law_that_was_found_is_drawn_as_sharp_as_it_is(study: ph.Study) -> None:
    (law,) = study.record.laws()
    assert law.law is not None and law.law.shape == law.x.shape
    size = study.record.size(study.added[0]).value
    is_moving = np.abs(law.x) > 0.1
    assert np.allclose(law.law[is_moving], -size * np.sign(law.x[is_moving]), rtol=0.01)
    names = [curve.name for curve in follows_chart(law).panels[0].curves]
    assert names == ["estimated", "the law that was found"]


def test_the_run_is_shown_in_which_the_models_differ_most(content) -> None:
    judged = [run for run in content.runs if run.part == "held out"]
    shown = content.runs[content.shown].channels[content.shown_channel]
    assert shown.change == max(one.change for run in judged for one in run.channels)
    above, below = run_chart(content, content.runs[content.shown], 0).panels
    assert above.height > below.height
    close = replace(shown, models=(shown.models[0], shown.models[0] + 1e-3))
    run = replace(content.runs[content.shown], channels=(close,))
    above, below = run_chart(content, run, 0).panels
    assert above.height < below.height


def test_the_file_is_small_and_loads_nothing(page: str) -> None:
    assert len(page.encode()) < MOST_BYTES
    reader = Reader(page)
    loaded = []
    for tag, attributes in reader.elements:
        for name in ("src", "href", "data", "action", "srcset"):
            if attributes.get(name) is not None:
                loaded.append((tag, attributes[name] or ""))
    assert loaded
    for tag, address in loaded:
        assert address.startswith(("#", "data:image/svg+xml;base64,")), tag
    assert not reader.all("link") and not reader.all("iframe")
    style = page.split("<style>")[1].split("</style>")[0]
    assert "url(" not in style and "@import" not in style
    assert "http:" not in page and "https:" not in page


def test_every_chart_has_a_picture_with_words_for_paper(page: str) -> None:
    reader = Reader(page)
    live = [one for one in reader.all("div") if one.get("class") == "live"]
    still = [one for one in reader.all("img") if one.get("class") == "still"]
    # staircase, runs, all data, the law of the friction, and two of the missing force
    assert len(live) == len(still) == 6
    for one in still:
        assert one["alt"] and len(one["alt"]) > 30
        svg = base64.b64decode((one["src"] or "").split(",")[1]).decode()
        assert "<svg" in svg
    assert "@media print" in page and "<noscript>" in page


def test_the_page_has_title_landmarks_language_and_headings(page: str) -> None:
    reader = Reader(page)
    tags = [tag for tag, _ in reader.elements]
    for tag in ("title", "main", "header", "nav", "footer", "h1"):
        assert tags.count(tag) == 1, tag
    assert reader.all("html")[0]["lang"] == "en"
    ids = [one["id"] for _, one in reader.elements if "id" in one]
    assert len(ids) == len(set(ids))
    for link in reader.all("a"):
        assert (link["href"] or "")[1:] in ids
    assert [one["id"] for one in reader.all("section")] == [*ORDER, "settings"]


def test_names_of_the_data_cannot_inject_anything(content: StudyContent) -> None:
    runs = []
    for place, run in enumerate(content.runs):
        channels = tuple(replace(one, name=HOSTILE) for one in run.channels)
        runs.append(replace(run, name=f"{HOSTILE} {place}", channels=channels))
    diagnosed = content.diagnoses[0]
    forces = []
    for force in diagnosed.forces:
        parts = tuple(replace(run, run=HOSTILE) for run in force.runs)
        forces.append(replace(force, equation=HOSTILE, runs=parts))
    text = HOSTILE
    ranked = Ranked(text, text, text, 0.5, 1.0, None, (text,), text)
    told = replace(diagnosed, forces=tuple(forces), ranking=(ranked,))
    hostile = replace(
        content,
        title=HOSTILE,
        headline=replace(
            content.headline, discovery=Answer(HOSTILE, HOSTILE), status=HOSTILE
        ),
        names=tuple(HOSTILE for _ in content.names),
        runs=tuple(runs),
        diagnoses=(told,),
        code=HOSTILE,
    )
    reader = Reader(html_report(hostile))
    assert len(reader.scripts) == 2  # data, our own
    data = unpacked(reader.scripts[0])
    assert data["measured"][0][0]["panels"][0]["label"].startswith(HOSTILE)
    assert "<" not in reader.scripts[0]
    assert HOSTILE in reader.text and "49" not in reader.text.split(HOSTILE)[0][-10:]
    assert not any("onerror" in attributes for _, attributes in reader.elements)
    for picture in reader.all("img"):
        assert (picture["src"] or "").startswith("data:image/svg+xml;base64,")
        drawn = base64.b64decode((picture["src"] or "").split(",")[1]).decode()
        assert "<script" not in drawn and "<img" not in drawn
    *_, last = markdown_report(hostile).rpartition("## Reproduce this result")
    lines = markdown_report(replace(hostile, code="")).splitlines()
    assert not any("<" in line for line in lines if not line.startswith("    "))
    assert f"    {HOSTILE}" in last.splitlines()


def unpacked(text: str) -> Any:
    """What the browser unpacks of a script element, which no text can end."""
    assert re.fullmatch(r"[\w+/=]*", text)
    return json.loads(gzip.decompress(base64.b64decode(text)))


def test_a_study_that_was_not_diagnosed_says_so_and_what_to_do(tmp_path: Path) -> None:
    asked = ph.Study(spring(), measurements(1))
    text = asked.report(tmp_path / "one.html").read_text(encoding="utf-8")
    reader = Reader(text)
    assert "not diagnosed yet" in reader.text
    assert "study.diagnose()" in reader.text
    assert "no data were held out" in reader.text
    verdict_and_errors = reader.text.split("Equations, before")[0]
    assert "None" not in verdict_and_errors and "nan" not in verdict_and_errors.split()


@pytest.mark.parametrize(("n_runs", "n_channels"), [(1, 1), (50, 8)])
def test_one_or_fifty_trajectories_and_eight_channels_with_gaps_come_out_well(
    content: StudyContent, n_runs: int, n_channels: int
) -> None:
    rng = np.random.default_rng(11)
    runs = []
    for k in range(n_runs):
        channels = tuple(_channel(rng, f"x{c}", 300) for c in range(n_channels))
        runs.append(Run(f"run {k}", "training", channels))
    many = replace(content, runs=tuple(runs), names=("base model",), shown=0)
    text = html_report(many)
    assert len(text.encode()) < MOST_BYTES
    reader = Reader(text)
    drawn = unpacked(reader.scripts[0])["measured"]
    assert len(drawn) == n_runs and len(drawn[0]) == n_channels
    assert None in drawn[0][0]["panels"][0]["curves"][0]["y"]
    named = [f"run {k} (training)" for k in range(n_runs)]
    assert all(name in reader.text for name in named)


def _channel(rng: np.random.Generator, name: str, n_samples: int) -> Channel:
    measured = rng.standard_normal(n_samples)
    measured[20:40] = np.nan
    t = np.arange(n_samples) / 10
    return Channel(name, "m", 0.1, t, measured, (np.zeros(n_samples),), (1.0,), 1.0)


def test_thinning_keeps_the_extremes_the_ends_and_a_gap() -> None:
    x = np.sin(np.arange(20_000) / 50)
    x[7_777] = 9.0
    x[9_000:9_100] = np.nan
    kept = thinned([x, -x], 400)
    assert len(kept) <= 400 + 2 + 100  # and one of each bin with a gap
    assert (np.diff(kept) > 0).all() and kept[0] == 0 and kept[-1] == len(x) - 1
    assert 7_777 in kept and np.isnan(x[kept]).any()
    assert np.array_equal(thinned([x[:50]], 400), np.arange(50))


@pytest.mark.parametrize(("unit", "of_time", "rate"), [
    ("kg m/s", "s", "N"),
    ("kg*m/s", "s", "N"),
    ("N s", "s", "N"),
    ("kg m^2/s", "s", "N m"),
    ("m", "s", "m/s"),
    ("m/s", "s", "m/s^2"),
    ("V s", "s", "V"),
    ("J", "s", "W"),
    ("C", "s", "C/s"),  # coulomb or degree Celsius: nobody knows
    ("mm", "s", "mm/s"),
    ("kg m/s", "min", "kg m/(min s)"),
    ("1/s", "s", "1/s^2"),
    ("mm/s", "s", "mm/s^2"),
    ("kN s", "s", "kN"),
    ("", "s", ""),
    ("m", "", ""),
])  # fmt: skip
def test_units_of_rates_are_those_that_people_write(unit, of_time, rate) -> None:
    assert rate_unit(unit, of_time) == rate


def test_a_second_storage_has_the_same_name_and_value_everywhere() -> None:
    air = ph.formula("(Ta - T)/tau + g*P", tau=30.0, g=1.0)
    room = ph.FirstOrder(["T"], {"T": air}, inputs=["Ta", "P"], kind="thermal")
    t = np.linspace(0.0, 48.0, 97)
    u = np.column_stack([np.zeros_like(t), (t // 8) % 2])
    walls = room.add("second heat storage", "T")
    values = {name: 0.25 for name in walls.free if name.startswith("second")}
    values |= {name: 12.0 for name in walls.free if name.startswith("storage")}
    x = ph.simulate(walls.with_values(values), t, [5.0, 5.0], u, hold="zero")[:, :1]
    x = x + 0.02 * np.random.default_rng(3).standard_normal(x.shape)
    units = {"t": "h", "T": "degC", "Ta": "degC", "P": "kW"}
    data = ph.Measurements.from_arrays(
        t, x, states=["T"], u=u, inputs=["Ta", "P"], units=units, hold="zero"
    )
    study = ph.Study(room, data)
    study.add("second heat storage", "T")
    content = study.content()
    rows = {row.name: row for row in content.models[-1].parameters}
    row = rows["time constant of the second storage in the equation of T"]
    told = with_error(row.value, row.std_error, row.unit)
    found = re.match(
        rf"Second heat storage \(time constant {re.escape(told)} and (\S+) ± \S+ times the "
        r"capacity of the first\) was missing\.",
        content.headline.discovery.lead,
    )
    assert found and abs(float(found[1]) - 3.0) < 0.5

"""The page results/field_machines.md, from the tables of all kinds that have been run.

Where seeds that are reported were run, those of developing are left out.
"""

import pandas as pd

from problems.field_machines import store
from problems.field_machines.examination import (
    CLASS,
    FALSE,
    MOST_STEPS,
    NAME,
    SILENT,
)
from problems.field_machines.findings import agree, of_text
from problems.field_machines.kinds import FIRST_REPORTED, KINDS, NOISE_LEVELS
from problems.field_machines.preparation import PREPARED
from problems.field_machines.sizes import (
    ABOVE_MODEL_ERROR,
    LOUDEST,
    MODEL_ERROR,
    QUIETEST,
)
from problems.tools import markdown
from problems.tools.intervals import share
from problems.tools.provenance import write

DEVELOPED_ON = "developed on seeds below 21000; those up to 33999 were seen"
ANSWERS = (NAME, CLASS, FALSE, SILENT)
LEVELS = markdown.enumerated(f"{100 * noise:g}" for noise in NOISE_LEVELS)
INTRODUCTION = markdown.paragraph(f"""
    Machines that an engineer meets are simulated by SciPy
    (`problems/field_machines`, without phsi_opt), an effect hidden, and given to a
    study with a model that lacks it. Every case has {MODEL_ERROR:.0%} of model error,
    or what its kind says: a
    random force, or a smooth random function of the states, whose root mean square is
    that share of the motion's own force (of those where nothing is missing, a third
    have noise that lasts instead). Noise is {LEVELS} % of a channel's root mean square.
    The effect's size is such that the best re-fit of the model has a free-run error of
    {QUIETEST:g} to {LOUDEST:g} times the noise, and {ABOVE_MODEL_ERROR:g} times what
    the model error does to the runs, which at little noise asks for more; under control
    and over the top it is drawn. Models of circuits, heated bodies and chambers say
    what kind of thing they are (`kind="electrical"`), as a user would.
    """)
TERMS = markdown.paragraph(f"""
    A study goes on by itself for up to {MOST_STEPS} steps; all that its diagnoses find
    is counted. Right name: every finding is one effect, and a true one. Class: every
    finding holds a true effect, and one of them several effects. False name: a finding
    without a true effect. Silent: nothing is found; where nothing is to be named, that
    is right. Intervals in brackets: 95 %, Wilson.
    """)


def write_page() -> None:
    """Write the page from the tables of all kinds that have been run."""
    write("field_machines.md", page())


def page() -> str:
    """The page as Markdown."""
    found = {}
    for name in KINDS:
        rows = _of_interest(store.table(name))
        if len(rows):
            found[name] = rows
    lines = ["# Machines of the field", "", INTRODUCTION, "", TERMS, ""]
    if not found:
        return "\n".join(lines)
    everything = pd.concat(found.values(), ignore_index=True)
    begin = f"Seeds from {everything['seed'].min()} on, of each kind as many as n says"
    lines += [f"{begin}; {DEVELOPED_ON}.", ""]
    lines += ["## What was said", "", markdown.table(summary(found)), ""]
    lines += ["By noise, where something is to be named:", ""]
    lines += [markdown.table(by_noise(everything)), ""]
    lines += ["## What came instead", "", _instead(everything), ""]
    lines += _preparation()
    lines += _failures(everything)
    counts = everything["commit"].value_counts()
    lines += ["## Examined on", ""]
    lines += [f"- commit {commit}: {count} cases" for commit, count in counts.items()]
    return "\n".join(lines)


def _of_interest(rows: pd.DataFrame) -> pd.DataFrame:
    """Seeds that are reported, where there are any."""
    is_reported = rows["seed"].ge(FIRST_REPORTED)
    return rows[is_reported] if is_reported.any() else rows


def summary(found: dict[str, pd.DataFrame]) -> list[dict[str, object]]:
    """A line for each kind; two where in some of its cases nothing is to be named."""
    records = []
    for name, rows in found.items():
        named = rows["listed"].astype(bool)
        title = KINDS[name].title
        if named.any():
            records.append(line(title, rows[named]))
        if not named.all():
            other = title if not named.any() else f"{title}, no name is right"
            records.append(line(other, rows[~named]))
    everything = pd.concat(found.values(), ignore_index=True)
    listed = everything["listed"].astype(bool)
    records.append(line("all with a name", everything[listed]))
    records.append(line("all without", everything[~listed]))
    return records


def line(title: str, rows: pd.DataFrame) -> dict[str, object]:
    """Shares of each answer, and the median of the seconds."""
    record: dict[str, object] = {"kind": title, "n": len(rows)}
    for answer in ANSWERS:
        record[answer] = share(int(rows["answer"].eq(answer).sum()), len(rows))
    record["median seconds"] = f"{rows['seconds'].median():.1f}"
    return record


def by_noise(rows: pd.DataFrame) -> list[dict[str, object]]:
    """A line for each noise level."""
    listed = rows[rows["listed"].astype(bool)]
    records = []
    for noise, part in listed.groupby("noise"):
        records.append(line(f"noise {100 * float(str(noise)):g} %", part))
    return records


def _instead(rows: pd.DataFrame) -> str:
    """What was said in the cases whose answer is neither right nor rightly silent."""
    is_silent = rows["answer"].eq(SILENT)
    wrong = rows[rows["answer"].eq(FALSE) | (is_silent & rows["listed"].astype(bool))]
    if wrong.empty:
        return "Nothing."
    said = wrong["findings"].where(wrong["findings"].ne(""), wrong["verdicts"])
    wrong = wrong.assign(said=said)
    counts = wrong.groupby(["kind", "hidden", "answer", "said"]).size()
    table = counts.reset_index(name="cases")
    table = table.sort_values(
        ["answer", "kind", "cases"], ascending=[True, True, False]
    )
    return markdown.table(table)


def _preparation() -> list[str]:
    records = []
    everything = []
    n_failed = 0
    for name, kind in KINDS.items():
        rows = _of_interest(store.table(name, is_prepared=True))
        is_examined = rows["outcome"].eq("examined")
        n_failed += int((~is_examined).sum())
        rows = rows[is_examined]
        if rows.empty:
            continue
        record: dict[str, object] = {"kind": kind.title, "n": len(rows)}
        records.append(record | _same(rows))
        everything.append(rows)
    if not records:
        return []
    joined = pd.concat(everything, ignore_index=True)
    records.append({"kind": "all", "n": len(joined)} | _same(joined))
    text = markdown.paragraph("""
        Whether the findings are the same to the letter, names and classes, where clocks
        begin at other times (shifted), with every other sample (thinned), and with
        another run held out (exchanged); and whether they agree: each finding shares an
        effect with one of the other preparation, or both are silent. A name and a class
        that holds it agree.
        """)
    failed = (
        f"Records of which one could not be solved, and that do not count: {n_failed}."
    )
    rest = f"{_disagreement(joined)} {failed}"
    table = markdown.table(records)
    return ["## Ways to prepare a record", "", text, "", table, "", rest, ""]


def _disagreement(rows: pd.DataFrame) -> str:
    """How many of all preparations agree, and what the others said."""
    n_agreeing = n_silent = n_named = 0
    for other in PREPARED[1:]:
        for own, said in zip(rows[PREPARED[0]], rows[other], strict=True):
            if agree(of_text(own), of_text(said)):
                n_agreeing += 1
            elif not said:
                n_silent += 1
            elif not own:
                n_named += 1
    n = len(rows) * (len(PREPARED) - 1)
    n_others = n - n_agreeing - n_silent - n_named
    return (
        f"All three ways together: {share(n_agreeing, n)} of {n} agree. Of the others "
        f"{n_silent} are silent where the record as drawn is not, {n_named} find "
        f"something where it is silent, and {n_others} say something else."
    )


def _same(rows: pd.DataFrame) -> dict[str, object]:
    """Shares of the cases in which a preparation says what the record itself says."""
    record: dict[str, object] = {}
    own = rows[PREPARED[0]]
    for other in PREPARED[1:]:
        count = int(rows[other].eq(own).sum())
        record[f"{other}: same"] = share(count, len(rows))
        pairs = zip(own, rows[other], strict=True)
        n_agreeing = sum(agree(of_text(a), of_text(b)) for a, b in pairs)
        record[f"{other}: agree"] = share(n_agreeing, len(rows))
    return record


def _failures(rows: pd.DataFrame) -> list[str]:
    failed = rows[rows["outcome"].ne("examined")]
    counts = (failed["kind"] + ": " + failed["outcome"]).value_counts()
    if counts.empty:
        return []
    lines = [f"- {count} x {what}" for what, count in counts.items()]
    return ["## Cases that failed", "", *lines, ""]

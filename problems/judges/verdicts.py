"""Two hundred verdicts as they were on one day, and what the present code says.

    python -m problems.judges.verdicts --check|--freeze [--processes=N] [--first=SEED]
        [--cases=N]

With --freeze the references in results/judges/verdicts.json are made; with --check the
present code is compared with them, case by case. Each case is written as it is done,
and the same command goes on where it was interrupted (a check: on the same commit).
--cases=N takes the first N alone; other seeds have files of their own, try_<seed>_*,
which are not committed. One fit and one diagnosis each; a study's further steps belong
to `battery`.

Right: where the catalogue has the hidden effect, every finding holds a true one ("right
name": and nothing else; "class": beside others). Where it has not, nothing is found;
and with nothing hidden in a machine of hidden effects the verdict is
"nothing missing", with a force of no catalogue "unexplained", or a function of its
quantity. (Where an effect imitates it that counts as wrong here; `battery` leaves it
out.)
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import time
from collections import Counter
from collections.abc import Mapping

import numpy as np

import phsi_opt as ph
from phsi_opt.criteria import DECISIVE_EVIDENCE
from problems.battery.ask import (
    CLASS,
    NAME,
    REASON_LENGTH,
    SILENT,
    Finding,
    Task,
    answer,
    as_text,
    findings_of,
    is_of_states,
    is_right_outside,
)
from problems.battery.draw import FIRST_VERDICT, ROWS, TABLES, draw
from problems.battery.records import HIDDEN
from problems.judges.cases import IN_VERDICTS, Record, kept, rounds, run
from problems.tools.command_line import flag, option
from problems.tools.intervals import share
from problems.tools.pages import render
from problems.tools.provenance import commit

FILE = "verdicts.json"
CHECK = "check_"  # begins the name of the file of a check, which is not committed
N_CASES = 200
NO_ANSWER, NOT_DRAWN = "failed", "not drawn"
# What silence has to say in these rows of hidden effects.
SILENCE = {"nothing": ph.Verdict.NOTHING_MISSING, "outside": ph.Verdict.UNEXPLAINED}
ODDS = 3.0  # a factor that no verdict should hang on
MOVED = 0.1  # standard errors by which a size has moved

Records = Mapping[str, Record]


def examined(task: Task) -> Record:
    """What the first diagnosis says of a task."""
    row = TABLES[task.battery][task.row]
    began = time.process_time()
    try:
        case = draw(row, task.seed)
    except (ArithmeticError, ValueError) as error:
        return {"answer": NOT_DRAWN, "verdict": str(error), "commit": commit()}
    names = case.listed
    record: Record = {
        "battery": task.battery,
        "row": task.row,
        "hidden": case.hidden,
        "noise": case.noise,
        "names": sorted(names),
        "commit": commit(),
    }
    drawn = time.process_time()
    try:
        fit = ph.identify(case.model, case.train)
        diagnosis = ph.diagnose(fit, case.train, held_out=case.test)
        found = findings_of(diagnosis)
        if case.has_function:  # it is true that a function of the states is missing
            found = {each for each in found if not all(map(is_of_states, each))}
        record |= told(names, SILENCE.get(row.kind, ""), diagnosis, found)
        if row.kind == "outside":
            record["right"] = is_right_outside(case.hidden, diagnosis)
    # Whatever goes wrong is a case without an answer.
    except Exception as error:
        said = f"{type(error).__name__}: {str(error)[:REASON_LENGTH]}"
        record |= {"verdict": said, "findings": "", "answer": NO_ANSWER, "right": False}
    seconds = time.process_time() - drawn
    return record | {"drawing": round(drawn - began, 2), "seconds": round(seconds, 2)}


def told(
    names: set[str], silence: str, diagnosis: ph.Diagnosis, found: set[Finding]
) -> Record:
    """Verdict, names, sizes, ties, and whether they are right."""
    said = answer(names, found)
    sizes = {}
    for finding in diagnosis.findings:
        sizes[str(finding.effects[0])] = [finding.coefficient, finding.std_error]
    table = diagnosis.candidates
    weighed = [one.log_evidence for one in diagnosis.ranking if one.was_weighed]
    return {
        "verdict": str(diagnosis.verdict),
        "findings": as_text(findings_of(diagnosis)),
        "sizes": sizes,
        "ties": "" if table.empty else str(table.iloc[0].confusable_with),
        "answer": said,
        "margin": abs(max(weighed, default=-np.inf) - DECISIVE_EVIDENCE),
        "right": is_right(names, silence, said, diagnosis.verdict),
    }


def is_right(names: set[str], silence: str, said: str, verdict: str) -> bool:
    """Whether an answer is right."""
    if names:
        return said in (NAME, CLASS)
    return said == SILENT and silence in ("", verdict)


def report(old: Records, new: Records) -> str:
    """What stays, what became right and what wrong, in all and by row."""
    both = [key for key in old if key in new and old[key]["answer"] != NOT_DRAWN]
    groups = {"all": both}
    for key in both:
        groups.setdefault(_group(old[key]), []).append(key)
    answers = Counter((old[key]["answer"], new[key]["answer"]) for key in both)
    turned = [key for key in both if old[key]["right"] != new[key]["right"]]
    return render(
        "judges/pages/verdicts.md",
        counts=[_shares(name, keys, old, new) for name, keys in groups.items()],
        answers=sorted(answers.items()),
        limit=MOVED,
        moved=_moved(old, new),
        odds=ODDS,
        near=[key for key in both if new[key].get("margin", np.inf) < np.log(ODDS)],
        turned=[(key, new[key]["right"], old[key]["hidden"]) for key in turned],
        said={key: (_text(old[key]), _text(new[key])) for key in turned},
    )


def _shares(group: str, keys: list[str], old: Records, new: Records) -> Record:
    pairs = Counter((old[key]["right"], new[key]["right"]) for key in keys)
    stay = sum(_text(old[key]) == _text(new[key]) for key in keys)
    counts = {
        "stay": stay,
        "right before": pairs[True, True] + pairs[True, False],
        "right now": pairs[True, True] + pairs[False, True],
        "became right": pairs[False, True],
        "became wrong": pairs[True, False],
    }
    n = len(keys)
    shares = {what: share(count, n) for what, count in counts.items()}
    return {"cases": group, "n": n, **shares}


def _group(record: Record) -> str:
    if record["battery"] != HIDDEN:
        machines = "machines of the field"
        return machines if record["names"] else f"{machines}, nothing to name"
    kind = ROWS[record["row"]].kind
    return f"one effect, noise {record['noise']:g}" if kind == "one" else kind


def _text(record: Record) -> str:
    return f"{record['verdict']}: {record.get('findings', '')}"


def _moved(old: Records, new: Records) -> str:
    n_all = n_moved = 0
    for key in old.keys() & new.keys():
        sizes = new[key].get("sizes", {})
        for name, (size, error) in old[key].get("sizes", {}).items():
            if name in sizes:
                n_all += 1
                n_moved += not abs(sizes[name][0] - size) <= MOVED * error
    return f"{n_moved} of {n_all}"


def main() -> None:
    """Freeze the verdicts, or compare with them."""
    if flag("check") == flag("freeze"):
        raise SystemExit(__doc__)
    first = int(option("first", str(FIRST_VERDICT)))
    n_cases = int(option("cases", str(N_CASES)))
    jobs = int(option("processes", "1"))
    tasks = rounds(first, IN_VERDICTS, n_cases)
    file = FILE if first == FIRST_VERDICT else f"try_{first}_{FILE}"
    if not flag("check"):
        run(file, examined, tasks, kept(file), jobs)
        return
    done = kept(CHECK + file)
    done = {key: one for key, one in done.items() if one["commit"] == commit()}
    run(CHECK + file, examined, tasks, done, jobs)
    wanted = {str(task) for task in tasks}
    print(report({k: one for k, one in kept(file).items() if k in wanted}, done))


if __name__ == "__main__":
    main()

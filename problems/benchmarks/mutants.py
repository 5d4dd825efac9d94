"""Mutation testing of the central modules: does a test fail for every small change?

    python -m problems.benchmarks.mutants [--sample=40] [--seed=1] [--show] [MODULE ...]

mutmut changes one thing at a time in a module (a sign, a limit, an argument) and runs
the tests that reach it, one mutant after the other. It works on a copy of the project,
with the modules and tests named in ``[tool.mutmut]`` of pyproject.toml. It changes no
functions with decorators, such as properties, and nothing outside of functions, such as
the tests of values in ``keys.py``, which are made at import.

Of every module a sample is drawn. The page is of seed 1; tests are written for what
survives of other seeds. Where modules are named (``statistics``), they alone are
changed, and no page is written; ``--show`` prints what no test noticed.
"""

import contextlib
import json
import re
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from mutmut.stats import status_by_exit_code

from problems.tools.command_line import chosen, flag, option
from problems.tools.pages import publish, render
from problems.tools.provenance import ROOT, git

REPORTED_SEED = 1
ASKED = 0.85  # of the mutants, that tests have to kill
KILLED = ("killed", "timeout", "segfault")  # a mutant that never ends is noticed too
NOT_REACHED = ("no tests", "skipped")


def copied(folder: Path) -> None:
    """The files under version control, as they are now."""
    for name in filter(None, (git("ls-files", "-z") or "").split("\0")):
        source = ROOT / name
        if source.is_file():
            target = folder / name
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source, target)


def limited(folder: Path, names: Sequence[str]) -> None:
    """Let mutmut change only the modules whose file has one of these names.

    Raises:
        SystemExit: there is no such module in the list.
    """
    path = folder / "pyproject.toml"
    text = path.read_text("utf-8")
    listed = re.search(r"only_mutate = \[(.*?)\]", text, re.DOTALL)
    assert listed is not None
    modules = re.findall(r'"(.+?)"', listed.group(1))
    kept = [module for module in modules if Path(module).stem in names]
    missing = sorted(set(names) - {Path(module).stem for module in kept})
    if missing:
        raise SystemExit(
            f"{missing[0]!r} is no module of [tool.mutmut] in pyproject.toml; "
            f"there are {', '.join(Path(module).stem for module in modules)}."
        )
    path.write_text(text.replace(listed.group(0), f"only_mutate = {json.dumps(kept)}"))


def drawn(folder: Path, most: int, seed: int) -> list[str]:
    """Names of at most so many mutants of every module.

    mutmut makes all mutants, runs the tests once to see which reach what, and finds
    none of the name "none".
    """
    with contextlib.suppress(SystemExit):
        run(folder, ["none"])
    rng = np.random.default_rng(seed)
    names: list[str] = []
    for statuses in outcomes(folder).values():
        mutants = sorted(statuses)
        names += rng.choice(mutants, min(most, len(mutants)), replace=False).tolist()
    return names


def run(folder: Path, names: Sequence[str]) -> None:
    """Run the tests on the mutants of these names; mutmut's output stays in a file.

    Raises:
        SystemExit: mutmut did not come to its end.
    """
    log = folder / "mutmut.log"
    with log.open("w") as stream:
        done = subprocess.run(
            [sys.executable, "-m", "mutmut", "run", "--max-children=1", *names],
            cwd=folder,
            stdout=stream,
            stderr=subprocess.STDOUT,
            check=False,
        )
    if done.returncode:
        end = log.read_text("utf-8", errors="replace")[-3000:]
        raise SystemExit(f"mutmut failed:\n{end}")


def outcomes(folder: Path) -> dict[str, dict[str, str]]:
    """Module -> mutant -> its status."""
    found = {}
    for path in sorted((folder / "mutants").rglob("*.meta")):
        codes: Mapping[str, int | None] = json.loads(path.read_text("utf-8"))[
            "exit_code_by_key"
        ]
        module = path.relative_to(folder / "mutants").as_posix().removesuffix(".meta")
        found[module] = {key: status_by_exit_code[code] for key, code in codes.items()}
    return {module: statuses for module, statuses in found.items() if statuses}


def tally(found: Mapping[str, Mapping[str, str]]) -> pd.DataFrame:
    """What became of the mutants of each module, and of all together.

    Raises:
        SystemExit: mutmut left some of them unchecked.
    """
    rows = []
    for module, statuses in found.items():
        counts = Counter(statuses.values())
        killed = sum(counts.pop(status, 0) for status in KILLED)
        survived = counts.pop("survived", 0)
        not_reached = sum(counts.pop(status, 0) for status in NOT_REACHED)
        if counts:
            raise SystemExit(f"{module}: mutmut left {dict(counts)} open.")
        total = killed + survived + not_reached
        rows.append((module, total, killed, survived, not_reached))
    columns = ["module", "mutants", "killed", "survived", "not reached"]
    table = pd.DataFrame(rows, columns=columns).set_index("module")
    table.loc["all"] = table.sum()
    return table.reset_index()


def show(folder: Path, statuses: Mapping[str, str]) -> None:
    """Print the change of each mutant that no test noticed."""
    for mutant, status in statuses.items():
        if status in KILLED:
            continue
        shown = subprocess.run(
            [sys.executable, "-m", "mutmut", "show", mutant],
            cwd=folder,
            capture_output=True,
            text=True,
            check=False,
        )
        changed = [
            line for line in shown.stdout.splitlines() if re.match(r"[-+][^-+]", line)
        ]
        print(f"{status}: {mutant}", *changed, sep="\n", flush=True)


def page(table: pd.DataFrame, sample: int, seed: int) -> str:
    """A row per module, and all of them together."""
    share = table["killed"] / table["mutants"]
    shown = table.assign(**{"share killed": share.map("{:.0%}".format)})
    values = {"share": share.iloc[-1], "total": table["mutants"].iloc[-1]}
    values |= {"asked": ASKED, "sample": sample, "seed": seed}
    return render("benchmarks/pages/mutants.md", shown=shown, **values)


def main() -> None:
    """Change, test, count, and write the page of all modules and the reported seed."""
    seed = int(option("seed", str(REPORTED_SEED)))
    sample = int(option("sample", "40"))
    with tempfile.TemporaryDirectory(prefix="mutants") as name:
        folder = Path(name)
        copied(folder)
        if chosen():
            limited(folder, chosen())
        names = drawn(folder, sample, seed)
        run(folder, names)
        found = {}
        for module, statuses in outcomes(folder).items():
            found[module] = {name: statuses[name] for name in names if name in statuses}
        text = page(tally(found), sample, seed)
        if flag("show"):
            for statuses in found.values():
                show(folder, statuses)
    publish("mutants.md", text, seed == REPORTED_SEED and not chosen())


if __name__ == "__main__":
    main()

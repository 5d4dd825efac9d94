"""What to do next after a diagnosis, by its verdict.

What is named is to be added, what the data do not tell apart asks for an experiment;
where nothing is named, the missing force says what to measure or to look at again.
"""

from collections.abc import Mapping, Sequence

from phsi_opt.diagnosis.finding import Finding
from phsi_opt.diagnosis.verdict import Verdict
from phsi_opt.force_analysis.analysis import ForceAnalysis
from phsi_opt.force_analysis.next_step import step_without_name
from phsi_opt.presentation.content import Answer

HOW_TO_ADD = (
    "In Python, study.add or study.auto adds it; phsi-opt study --auto on the command "
    "line."
)
PROPOSED_EXPERIMENT = "found.separation proposes one"


def next_step(
    verdict: Verdict,
    findings: Sequence[Finding],
    analysis: ForceAnalysis,
    units: Mapping[str, str],
) -> Answer:
    """What to add, to measure, to try or to look at again.

    Args:
        verdict: of the diagnosis.
        findings: what is established.
        analysis: of the missing forces.
        units: as in `Measurements`.
    """
    if verdict == Verdict.NOTHING_MISSING:
        return Answer(
            "Nothing: what is left looks like noise.",
            "Check the model in other conditions of operation: these data confirm it "
            "where they were taken.",
        )
    if not findings:
        return step_without_name(analysis, units)
    return _of_findings(findings, verdict == Verdict.PARTLY_NAMED)


def _of_findings(findings: Sequence[Finding], more_is_missing: bool) -> Answer:
    """To add what is named, or to tell the members of a class apart."""
    firsts = " and ".join(str(finding.effects[0]) for finding in findings)
    again = ", then diagnose again" if more_is_missing else ""
    classes = [finding for finding in findings if not finding.is_name]
    if not classes:
        return Answer(f"Add {firsts}{again}.", HOW_TO_ADD)
    apart = []
    for finding in classes:
        first, *others = map(str, finding.effects)
        apart.append(f"{first} from {', '.join(others)}")
    return Answer(
        f"Tell {'; '.join(apart)} by an experiment; {PROPOSED_EXPERIMENT}.",
        f"Until then, {firsts} may stand in the model{again}. {HOW_TO_ADD}",
    )

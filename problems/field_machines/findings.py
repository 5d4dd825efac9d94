"""What a diagnosis says is missing: names, and classes of names that do equally well.

This is the one place that knows how a diagnosis says it. Until it has findings of its
own, an effect that the verdict names is one, with all that it is confusable with.
"""

import phsi_opt as ph

Finding = frozenset[str]  # "viscous damping on p", ...


def findings_of(diagnosis: ph.Diagnosis) -> set[Finding]:
    """What is established to be missing."""
    if diagnosis.verdict != ph.Verdict.NAMED:
        return set()
    alike = {}
    for candidate in diagnosis.ranking:
        alike[str(candidate.effect)] = candidate.confusable_with
    found = set()
    for effect in diagnosis.proposed:
        name = str(effect)
        found.add(frozenset({name, *alike.get(name, ())}))
    return found


def as_text(found: set[Finding]) -> str:
    """Findings by semicolons, members of a class by "or"; sorted."""
    return "; ".join(sorted(" or ".join(sorted(one)) for one in found))

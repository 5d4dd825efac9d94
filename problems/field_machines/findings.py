"""What a diagnosis says is missing: names, and classes that do equally well."""

import phsi_opt as ph

Finding = frozenset[str]  # "viscous damping on p", ...


def findings_of(diagnosis: ph.Diagnosis) -> set[Finding]:
    """What is established to be missing."""
    found = set()
    for finding in diagnosis.findings:
        found.add(frozenset(str(effect) for effect in finding.effects))
    return found


def as_text(found: set[Finding]) -> str:
    """Findings by semicolons, members of a class by "or"; sorted."""
    return "; ".join(sorted(" or ".join(sorted(one)) for one in found))

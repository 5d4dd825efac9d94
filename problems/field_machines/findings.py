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


def of_text(text: str) -> set[Finding]:
    """The findings that `as_text` wrote."""
    return {frozenset(one.split(" or ")) for one in text.split("; ") if one}


def agree(one: set[Finding], other: set[Finding]) -> bool:
    """Whether two say nothing that the other does not bear out.

    Every finding of each shares an effect with one of the other; both may be silent. A
    class and a name from within it agree.
    """
    if not one or not other:
        return not one and not other
    return _is_borne_out(one, other) and _is_borne_out(other, one)


def _is_borne_out(said: set[Finding], by: set[Finding]) -> bool:
    return all(any(finding & known for known in by) for finding in said)

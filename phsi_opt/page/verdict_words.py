"""The first screen in words: what is wrong, where, since when, what to add."""

from dataclasses import dataclass

from phsi_opt.criteria import FAILING_ERROR
from phsi_opt.page.snapshot import CandidateRow, Diagnosed, Snapshot
from phsi_opt.presentation.numbers import capitalised, number, said
from phsi_opt.presentation.report_content import Answer


@dataclass(frozen=True)
class Facts:
    """The verdict in a sentence, and the four answers.

    Attributes:
        sentence: what is missing.
        what: what is wrong, with how much.
        where: where it is.
        since: since when.
        add: what to add, or what comes nearest; "" for nothing.
        preview: the error that it would leave, in words.
        to_do: what to do where nothing is named; "" where something is.
    """

    sentence: str
    what: Answer
    where: Answer
    since: Answer
    add: str
    preview: str
    to_do: Answer


def facts_of(snapshot: Snapshot) -> Facts | None:
    """The four answers; None before the present model was diagnosed."""
    diagnosed = snapshot.diagnosed
    if diagnosed is None:
        return None
    if not diagnosed.is_missing:
        reason = said(diagnosed.reason)
        return Facts(
            _nothing_words(snapshot),
            Answer("Nothing that these data show.", _left_words(snapshot)),
            Answer("No place stands out: what is left looks like noise."),
            Answer("No time stands out."),
            "",
            f"{capitalised(reason)}.",
            Answer(""),
        )
    row = row_to_add(diagnosed)
    preview = "" if row is None else preview_words(snapshot, row)
    return Facts(
        diagnosed.missing,
        diagnosed.wrong,
        diagnosed.where,
        diagnosed.since,
        diagnosed.proposed or diagnosed.nearest,
        preview,
        Answer("") if diagnosed.is_named else diagnosed.to_do,
    )


def _nothing_words(snapshot: Snapshot) -> str:
    """That nothing is missing; more is not said beside what is not established."""
    if not snapshot.unestablished:
        return "Nothing is missing."
    return f"No force is evident; {snapshot.unestablished}."


def preview_words(snapshot: Snapshot, row: CandidateRow) -> str:
    """The error before and after, on the data that judge where that is known."""
    now = snapshot.steps[-1]
    before = now.judged
    after = row.held_out
    part = snapshot.judged_part
    if now.held_out is None or after != after:  # NaN: not re-fitted there
        before = now.train
        after = row.train
        part = "training"
    if after != after:
        return "The error that it would leave is not known."
    trend = _trend(before, after)
    if part == snapshot.judged_part and after <= FAILING_ERROR * now.floor < before:
        trend += ", at the noise floor"
    which = part.replace(" ", "-").capitalize()
    return (
        f"{which} error {error_words(snapshot, before)} → "
        f"{error_words(snapshot, after)} ({trend})"
    )


def _trend(before: float, after: float) -> str:
    """By how much an error falls or rises, in whole percent."""
    percent = round(100 * (after / before - 1))
    if percent == 0:
        return "unchanged"
    return f"{abs(percent)} % {'less' if percent < 0 else 'more'}"


def _left_words(snapshot: Snapshot) -> str:
    """The error of the last step beside the noise floor, and from where it fell."""
    last = snapshot.steps[-1]
    left = error_words(snapshot, last.judged)
    floor = error_words(snapshot, last.floor)
    if len(snapshot.steps) == 1:
        return f"The error is {left}, the noise floor {floor}."
    first = error_words(snapshot, snapshot.steps[0].judged)
    return f"The error fell from {first} to {left}; the noise floor is {floor}."


def proposed_size(snapshot: Snapshot) -> str:
    """The size of what is to be added, behind a comma; "" where it is not known."""
    row = None if snapshot.diagnosed is None else row_to_add(snapshot.diagnosed)
    return f", {row.size}" if row is not None and row.size else ""


def error_words(snapshot: Snapshot, value: float) -> str:
    """An error with its unit."""
    unit = f" {snapshot.unit}" if snapshot.unit else ""
    return f"{number(value, 3)}{unit}"


def share_left(snapshot: Snapshot, row: CandidateRow) -> tuple[float, float]:
    """The error that would be left, and the noise floor, as shares of the present."""
    now = snapshot.steps[-1]
    after = row.held_out if now.held_out is not None else row.train
    before = now.judged
    if after != after:
        after = row.train
        before = now.train
    if after != after or before <= 0:
        return 1.0, 0.0
    return min(after / before, 1.0), min(now.floor / before, 1.0)


def row_to_add(diagnosed: Diagnosed) -> CandidateRow | None:
    """The candidate that is proposed, or comes nearest."""
    wanted = diagnosed.proposed or diagnosed.nearest
    for row in diagnosed.candidates:
        if row.effect == wanted:
            return row
    return None

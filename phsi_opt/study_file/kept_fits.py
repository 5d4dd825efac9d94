"""Fits and diagnoses of a study file, kept in a file beside it.

They are used again only if all on which they depend is as it was: the model, the loss,
the measurements, and the package; for a diagnosis also the effects to consider. The
file holds numbers and text, as that of a saved fit, and nothing in it is run. One that
is damaged, or belongs to another model or to other measurements, counts as empty;
deleting it is always safe. Free runs and missing forces are computed again.
"""

import json
import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, Self, get_type_hints

from phsi_opt.comparison.compare import compare_record
from phsi_opt.data.checks import Hold
from phsi_opt.data.measurements import Measurements
from phsi_opt.diagnosis.record import Diagnosis
from phsi_opt.diagnosis.refit import DiagnosedModel
from phsi_opt.errors import DataError, PhsiOptError
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.fit_file import DAMAGE, Content, decoded, digest_of, encoded
from phsi_opt.model.catalogue import EffectChoice
from phsi_opt.reading import file_text
from phsi_opt.study import Study
from phsi_opt.study.record import StudyRecord
from phsi_opt.study_file.sections import Sections
from phsi_opt.writing import write_whole

SUFFIX = ".cache"  # behind the name of the study file
PACKAGE = Path(__file__).parents[1]


@dataclass(frozen=True)
class KeptFits:
    """The fits of one study, by the effects that are added."""

    path: Path  # of their file
    key: str  # tells this study from others
    hold: Hold = "linear"  # of the inputs, as the study file has it

    @classmethod
    def of(cls, study_file: Path, sections: Sections, train: Measurements) -> Self:
        """Those of a study file, with what it says and the measurements to fit."""
        # The files of the package, which a developer changes, belong to its version.
        edition = map(os.path.getmtime, sorted(PACKAGE.rglob("*.py")))
        asked = (sections.base, sections.loss, sections.own_effects)
        data = (train.digest, train.units, train.hold, train.noise)
        key = digest_of(version("phsi_opt"), list(edition), asked, data)
        path = study_file.with_name(study_file.name + SUFFIX)
        return cls(path, key, train.hold)

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies read the file again."""
        return type(self), (self.path, self.key, self.hold)

    def with_effects(self, added: Sequence[object] = ()) -> Fit | None:
        """The fit of the base model with effects; None: it is to be fitted."""
        with suppress(PhsiOptError, *DAMAGE):
            return Fit.from_content(self._entries[_name(added, self.hold)])
        return None

    def diagnosis(
        self, study: StudyRecord, considered: EffectChoice
    ) -> Diagnosis | None:
        """The diagnosis of the last step of a study; None: it is to be made."""
        asked = (considered, study.train.hold)
        with suppress(PhsiOptError, *DAMAGE):
            question = _question(study, study.last.added, asked)
            return _diagnosis_from(self._entries[question], study)
        return None

    def keep(self, study: Study) -> None:
        """Keep fits and diagnoses of the steps of a study, and what it would add next.

        Where the file cannot be written they are made again the next time.
        """
        record = study.record
        found: dict[str, Callable[[], Content]] = {}
        for step in study.steps:
            name = _name(step.added, step.fit.hold)
            found.setdefault(name, partial(step.fit.content, True))
        for number, one in record.diagnoses.items():
            added = record.steps[number].added
            if one.proposed_fit is not None:
                name = _name((*added, *one.proposed), one.proposed_fit.hold)
                found.setdefault(name, partial(one.proposed_fit.content, True))
            question = _question(record, added, study.considered[number])
            found[question] = partial(_diagnosis_content, one)
        if found.keys() <= self._entries.keys():
            return
        self._entries.update(self._read())  # another command may have kept some
        for name in found.keys() - self._entries.keys():
            self._entries[name] = found[name]()
        text = json.dumps({"key": self.key, "found": self._entries})
        with suppress(DataError):
            write_whole(self.path, f"{digest_of(text)}\n{text}\n")

    @cached_property
    def _entries(self) -> dict[str, Content]:
        return self._read()

    def _read(self) -> dict[str, Content]:
        with suppress(OSError, *DAMAGE):
            digest, text, _ = file_text(self.path).split("\n")
            content = json.loads(text)
            if (digest, content["key"]) == (digest_of(text), self.key):
                return dict(content["found"])
        return {}


def _name(added: Sequence[object], hold: Hold) -> str:
    return json.dumps([list(map(str, added)), encoded(hold)], sort_keys=True)


def _question(
    study: StudyRecord, added: Sequence[object], considered: tuple[EffectChoice, Hold]
) -> str:
    """What a diagnosis answers: of which step, judged by what, among which effects."""
    choice, hold = considered
    held_out = study.held_out and study.held_out.digest
    return f"{_name(added, hold)} {held_out} {choice}"


# ---- as numbers and text -------------------------------------------------------------

PLAIN = ("verdict", "reason", "findings", "proposed")


def _diagnosis_content(found: Diagnosis) -> Content:
    """Without free runs; only the first candidate keeps its re-fit."""
    first = found.ranking[0].fit if found.ranking else None
    if first is found.proposed_fit:
        first = None
    aligned = found.record.aligned
    content: Content = {"hold": encoded(aligned.data.hold), "notes": aligned.notes}
    fits = (found.fit, found.proposed_fit, first)
    content["fits"] = [one and one.content(states=True) for one in fits]
    plain = partial(replace, states=None, fit=None, trained=None, comparison=None)
    content["ranking"] = encoded(list(map(plain, found.ranking)))
    for name in PLAIN:
        content[name] = encoded(getattr(found, name))
    return content


def _diagnosis_from(content: Content, study: StudyRecord) -> Diagnosis:
    """The diagnosis of the last step of a study, with free runs made again."""
    own, proposed, first = (one and Fit.from_content(one) for one in content["fits"])
    step = study.last
    held = study.held_as(content["hold"], tuple(content["notes"]))
    if own.values != step.fit.values or held.train.hold != study.train.hold:
        step = held.step(step.label, step.added, own)
    parts: dict[str, Any] = {}
    for name in ("ranking", *PLAIN):
        parts[name] = decoded(get_type_hints(Diagnosis)[name], content[name])
    base = DiagnosedModel.of(step.train, step.held_out, study.loss)
    if first or proposed:
        if first:
            larger = base.with_run(compare_record(base.record.refitted(first)))
        else:
            larger = base.with_fit(proposed)
        best, *others = parts["ranking"]
        runs = (larger.trained, larger.judged)
        best = replace(best, fit=larger.fit, trained=runs[0], comparison=runs[1])
        parts["ranking"] = (best, *others)
    return Diagnosis(base.record, base.judged, proposed_fit=proposed, **parts)

"""Fits of a study file, kept in a file beside it: nothing is fitted twice.

A fit is used again only if all on which it depends is as it was: the model, the loss,
the measurements that are fitted, and the package. The file holds numbers and text, as
that of a saved fit, and nothing in it is run. One that is damaged, or belongs to
another model or to other measurements, counts as empty; deleting it is always safe.
"""

import hashlib
import json
import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any, Self

import numpy as np

from phsi_opt.data.measurements import Measurements
from phsi_opt.errors import DataError, PhsiOptError
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.fit_file import DAMAGE, Content, encoded, model_content
from phsi_opt.reading import file_text
from phsi_opt.study import Study
from phsi_opt.study_file.sections import Sections
from phsi_opt.writing import write_whole

SUFFIX = ".cache"  # behind the name of the study file
PACKAGE = Path(__file__).parents[1]


@dataclass(frozen=True)
class KeptFits:
    """The fits of one study, by the effects that are added."""

    path: Path  # of their file
    key: str  # tells this study from others

    @classmethod
    def of(cls, study_file: Path, sections: Sections, train: Measurements) -> Self:
        """Those of a study file, with what it says and the measurements to fit."""
        content: list[Any] = [_edition(), model_content(sections.base)]
        content += map(encoded, (sections.loss, sections.own_effects))
        content += [train.digest, *map(encoded, (train.units, train.hold, train.noise))]
        text = json.dumps(content, default=repr)
        return cls(study_file.with_name(study_file.name + SUFFIX), _digest(text))

    def with_effects(self, added: Sequence[object] = ()) -> Fit | None:
        """The fit of the base model with effects; None: it is to be fitted."""
        try:
            entry = self._entries[_name(added)]
            states = tuple(map(np.array, entry["states"]))
            return replace(Fit.from_content(entry["fit"]), states=states)
        except (PhsiOptError, *DAMAGE):
            return None

    def keep(self, study: Study) -> None:
        """Keep the fits of the steps of a study, and that of what it would add next.

        Where the file cannot be written they are fitted again the next time.
        """
        fits: dict[str, Fit] = {}
        for step in study.steps:
            fits.setdefault(_name(step.added), step.fit)
        found = study.record.present
        if found is not None and found.proposed_fit is not None:
            fits[_name((*study.added, *found.proposed))] = found.proposed_fit
        if fits.keys() <= self._entries.keys():
            return
        self._entries.update(self._read())  # another command may have kept some
        for name in fits.keys() - self._entries.keys():
            fit = fits[name]
            self._entries[name] = {"fit": fit.content(), "states": encoded(fit.states)}
        text = json.dumps({"key": self.key, "fits": self._entries})
        with suppress(DataError):
            write_whole(self.path, f"{_digest(text)}\n{text}\n")

    @cached_property
    def _entries(self) -> dict[str, Content]:
        return self._read()

    def _read(self) -> dict[str, Content]:
        try:
            digest, text, _ = file_text(self.path).split("\n")
            content = json.loads(text) if digest == _digest(text) else {}
            return dict(content["fits"]) if content["key"] == self.key else {}
        except (OSError, *DAMAGE):
            return {}


def _name(added: Sequence[object]) -> str:
    return " and ".join(map(str, added))


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _edition() -> list[Any]:
    """The version of the package, and its files, which a developer changes."""
    files = sorted(PACKAGE.rglob("*.py"))
    return [version("phsi_opt"), *map(os.path.getmtime, files)]

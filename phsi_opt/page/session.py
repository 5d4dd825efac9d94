"""One browser's study: drafts, results and the work that goes on; without a browser.

It outlives the page that shows it: a page that is loaded again shows the same session.
Everything that a view may do is a method here; the views only draw what it holds.

Its files lie in two folders: what it writes itself, and what was uploaded. The names on
the disk are its own; a user's name for a file is shown, and is no path. A process of
its own reads them, and is ended where that takes too long.
"""

import os
import re
import shutil
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import filterfalse
from pathlib import Path, PurePath
from typing import Any

from phsi_opt.errors import Complaint, DataError, PhsiOptError, StudyFileError, some_of
from phsi_opt.page import drafts, worker
from phsi_opt.page.worker import Order, Returned, Shown, WorkerHandle, example
from phsi_opt.presentation.content import Follows, StudyContent
from phsi_opt.presentation.numbers import duration, proper_names
from phsi_opt.study_file.gallery import BaseModel
from phsi_opt.study_file.model_file import model_alone_in
from phsi_opt.study_file.study_file import StudyFile
from phsi_opt.writing import write_whole

WORKING_FILE = "working_study.toml"
FITTING_FILE = "fitting_study.toml"
FITTED_FILE = "fitted_study.toml"
OPENED_FILE = "opened_study.toml"
REPORT_FILE = "report.html"
COUNTED = re.compile(r"\((\d+) of (\d+)\)$")  # the number of a step among all
READ_WITHIN = 60.0  # processor seconds of a call of the process that reads
HAS_ENDED = "this study has ended; load the page again."
NO_TABLE = Complaint("data.files", "", "there is no table yet; upload a file.")


@dataclass
class Look:
    """The run, channel and time that the charts show, by numbers; None: no time."""

    run: int = 0
    channel: int = 0
    t: float | None = None

    @classmethod
    def worst(cls, content: StudyContent | None) -> "Look | None":
        """Where the present model is off most; None: nothing sure is missing."""
        if content is None or content.present is None or not content.present.forces:
            return None
        return cls(*content.worst)


@dataclass(frozen=True, eq=False)
class Model:
    """A fitted model, to which one can go back."""

    content: StudyContent  # of the study whose present model it is
    study: Path  # what the worker sent of it, to go on from; memory has no room for all
    drafted: drafts.Drafted  # what was fitted
    laws: tuple[Follows, ...] = ()  # of the effects added, once they are known

    @property
    def name(self) -> str:
        """What was done last, such as "+ Coulomb friction on p"."""
        steps = self.content.steps
        return proper_names(steps[-1].change(len(steps) - 1))


@dataclass
class Moment:
    """What was filled in and shown, to which undo and redo go."""

    draft: drafts.StudyDraft
    model: int | None  # its number; None before there was one


@dataclass
class Job:
    """Work that goes on."""

    order: Order
    label: str  # such as "Fitting and diagnosing"
    line: str = ""  # what the worker said last; "" for nothing yet
    began: float = field(default_factory=time.monotonic)
    counted: float = 0.0  # when the first of counted steps began

    def take(self, line: str) -> None:
        """Note what the worker says; a line may end in "(3 of 12)"."""
        self.line = line
        if (found := COUNTED.search(line)) and found[1] == "1":
            self.counted = time.monotonic()

    @property
    def times(self) -> str:
        """How long it has taken, and what counted steps will take at most."""
        now = time.monotonic()
        said = duration(now - self.began)
        found = COUNTED.search(self.line)
        if found is None or found[1] == "1":
            return said
        n_done, n_steps = int(found[1]) - 1, int(found[2])
        left = (now - self.counted) / n_done * (n_steps - n_done)
        return f"{said}, at most {duration(left)} more for these {n_steps}"

    @property
    def words(self) -> str:
        """What is done now, with what the worker said last."""
        return f"{self.label}: {self.line}" if self.line else self.label


class Session:
    """The study of one browser.

    Args:
        folder: for its files, of nobody else; it is removed by ``close``.
        study_file: a study file to begin with, which has been read without complaint.
    """

    def __init__(self, folder: Path, study_file: Path | None = None) -> None:
        self.folder = folder
        self._state = folder / "state"
        self._uploads = folder / "uploads"
        for part in (self._state, self._uploads):
            part.mkdir(parents=True)
        self._n_uploads = 0
        self.draft = drafts.StudyDraft()  # what the user filled in
        self.upload_error = ""  # why the last file was refused
        self.job: Job | None = None  # the work that goes on
        # What was handed out last, or how the last job ended where not well.
        self.message = ""
        self.failure = ""  # why the last job could not be done
        self.models: list[Model] = []  # that were fitted, the oldest first
        self.now: int | None = None  # number of the one that is shown
        self.compared: int | None = None  # of the one that is drawn beside it
        self.look = Look()  # what its charts show
        self.report_path: Path | None = None  # the report that was written last
        # Counts changes after which the fields of drafts are drawn anew; and all else.
        self.shape = 0
        self.version = 0
        self.seen = time.monotonic()  # when a page last asked
        self.is_shown = False  # whether a page has ever asked; a program does not
        self.is_closed = False  # it has ended; a page that shows it is loaded again
        self._worker: WorkerHandle | None = None  # that solves
        self._reader: WorkerHandle | None = None  # that reads files
        self._calling = threading.Lock()
        self._idle_since = time.monotonic()
        self._fitting: drafts.Drafted | None = None
        self._waiting = ""  # the name of a study file whose tables are not there yet
        self._checking = threading.RLock()
        self._taking = threading.Lock()
        self._origin = study_file
        if study_file is not None:
            self._open(study_file)
        self.complaints: tuple[Complaint, ...] = (NO_TABLE,)
        self.seen_data = drafts.Seen()
        self._checked: drafts.Drafted | None = None  # the draft of which these are
        self._check()
        self._begun = self.draft.as_it_is()
        self._moments = [Moment(deepcopy(self.draft), None)]
        self._moment = 0  # number of the present one

    # ---- drafts ----------------------------------------------------------------------

    def _open(self, path: Path, places: dict[str, Path] | None = None) -> None:
        """Begin with a study file; its tables lie beside it unless told otherwise."""
        self.draft = self._call(places, drafts.StudyDraft.read, path, places)

    def open_example(self, name: str) -> None:
        """Begin with a study that comes with the package, and fit it."""
        self._open(example(name))
        self.shape += 1
        self.fit()

    def upload(self, name: str, content: bytes) -> bool:
        """Take a table or a study file; whether it could be used.

        A further table with the same columns is a further run; one of the same name
        takes its place. A study file is opened when all of its tables are there.
        ``upload_error`` says why one was refused, and the files before it stay.
        """
        name = re.split(r"[/\\]", name)[-1]  # without folders that a browser may tell
        with self._looking_again():
            if refusal := self._refusal(name, content):
                raise DataError(refusal)
            if drafts.suffix_of(name) == drafts.STUDY_KIND:
                write_whole(self._state / OPENED_FILE, content)
                self._waiting = name
            else:
                self._take(name, content)
            if self._waiting:
                self._open_waiting()
            self._ready_worker()
        return not self.upload_error

    def _open_waiting(self) -> None:
        """Open the study file that was uploaded, once all of its tables are."""
        path = self._state / OPENED_FILE
        known = self.draft.places
        name, self._waiting = self._waiting, ""
        try:
            base = self._call({}, model_alone_in, path)
            if base is not None:
                self.choose(replace(base, name=name, title=PurePath(name).stem))
                return
            named = self._call({}, drafts.files_of, path)
            lacking = [one for one in named if PurePath(one).name not in known]
            if lacking:
                self.message = f"{name} reads {some_of(lacking)}: upload this as well."
                self._waiting = name
                return
            self._open(path, {file: known[PurePath(file).name] for file in named})
        except PhsiOptError as error:
            wrong = getattr(error, "complaints", (error,))[:3]
            said = f"{name}: {'; '.join(map(str, wrong))}"
            raise DataError(said) from None

    def _refusal(self, name: str, content: bytes) -> str:
        """Why a file is not even looked at; "" where it is."""
        if self.is_closed:
            return HAS_ENDED
        if (n_known := len(self.draft.places)) >= drafts.MOST_FILES:
            return f"there are {n_known} files already, at most {drafts.MOST_FILES}."
        return drafts.refusal_of(name, len(content))

    def _take(self, name: str, content: bytes) -> None:
        """Store a table under a name of the page's own, and look at all files."""
        # Columns that are known keep what was said of them.
        self._n_uploads += 1
        place = self._uploads / f"table_{self._n_uploads}{drafts.suffix_of(name)}"
        place.write_bytes(content)
        try:
            self._take_file(name, place)
        except DataError:
            place.unlink()
            raise
        # Uploads that neither the draft nor a fit names any more are removed.
        naming: list[Any] = [self.draft, *(one.draft for one in self._moments)]
        naming += [self._fitting or self.draft, *(one.drafted for one in self.models)]
        used = [path for one in naming for path in one.places.values()]
        for path in filterfalse(used.__contains__, self._uploads.iterdir()):
            path.unlink()

    def _take_file(self, name: str, place: Path) -> None:
        known = self.draft.data
        data = self._look_at({name: place})
        is_alike = known is not None and known.headers == data.headers
        is_study = any(at.parent != self._uploads for at in self.draft.places.values())
        if known is not None and is_alike and not is_study:
            known.take_files(self._look_at({**known.places, name: place}))
        else:
            self.draft.data = data
            why = "is a separate table" if is_alike else "has other columns"
            if known is not None:
                self.message = f"{name} {why}: it replaces {', '.join(known.places)}."

    def _look_at(self, places: dict[str, Path], sheet: str = "") -> drafts.DataDraft:
        """The columns of files, of a sheet or group; by default of the chosen one."""
        known = self.draft.data
        chosen = sheet or (drafts.sheet_of(known.settings) if known else None)
        return self._call(places, drafts.look_at, places, chosen)

    def remove_file(self, name: str) -> None:
        """Take a table away; with the last one its columns go."""
        with self._looking_again() as data:
            (left := self.draft.places).pop(name, None)
            if left:
                data.take_files(self._look_at(left))
            else:
                self.draft.data = None

    def choose_sheet(self, name: str) -> None:
        with self._looking_again() as data:
            if data.places:
                found = self._look_at(data.places, name)
                self.draft.data = replace(found, parts=data.parts)

    @contextmanager
    def _looking_again(self) -> Iterator[drafts.DataDraft]:
        """The data, to be read in another way; why that cannot be is told."""
        with self._taking:  # a browser sends several at once
            self.upload_error = self.message = ""
            try:
                yield self.draft.data or drafts.DataDraft({})
            except DataError as error:  # a file has changed, or is gone
                self.upload_error = str(error)
            self.check()
            self.shape += 1  # at last: a page may look at any time

    def choose(self, base: BaseModel) -> None:
        """Begin with an entry of the gallery; columns become its states."""
        self.message = ""
        data = self.draft.data
        if data is not None:
            base = drafts.match_states(data, base)
            self.message = drafts.left_over(data.columns, base)
        self.draft.model = drafts.draft_of(base, data)
        self.draft.kept.get("study", {}).pop("added", None)
        self.check()
        self.shape += 1

    def check(self) -> tuple[Complaint, ...]:
        """Read the draft as a study file; keep and return what is wrong with it."""
        self.failure = ""  # what is checked is not what failed any more
        with self._checking:  # checks run beside each other, and write one file
            self._keep_moment()
            self._check()
        self.version += 1
        return self.complaints

    def _check(self) -> None:
        now = self.draft.as_it_is()
        if now == self._checked:
            return
        self._checked = now
        self.complaints, seen = (NO_TABLE,), drafts.Seen()
        if now.places:
            path = write_whole(self._state / WORKING_FILE, now.text)
            given = (path, now.places, self.seen_data.key)
            try:
                found = self._call(now.places, drafts.checked, *given)
            except DataError as error:  # it took too long; the next check tries again
                found = (Complaint("", "", str(error)),), None
                self._checked = None
            self.complaints, seen = found
        self.seen_data = seen or self.seen_data

    @property
    def model(self) -> Model | None:
        return None if self.now is None else self.models[self.now]

    @property
    def content(self) -> StudyContent | None:
        return None if self.model is None else self.model.content

    @property
    def is_diagnosing(self) -> bool:
        """Whether what the model that is shown lacks is being worked out."""
        is_open = self.content is not None and self.content.present is None
        return is_open and self.job is not None and self.job.order.func != worker.report

    @property
    def is_stale(self) -> bool:
        """Whether the draft has changed since the model that is shown was fitted."""
        model = self.model
        return model is not None and model.drafted != self.draft.as_it_is()

    @property
    def is_empty(self) -> bool:
        """Whether nobody filled in or began anything, so that nothing would be lost."""
        if self.job is not None or self.content is not None:
            return False
        return self.draft.as_it_is() == self._begun

    def show_up(self) -> None:
        """Note that a page shows it; its processes start before they are needed."""
        self.seen = time.monotonic()
        if not self.is_shown:
            self.is_shown = True
            self._ready_reader()
            self._ready_worker()

    # ---- work ------------------------------------------------------------------------

    def fit(self) -> None:
        """Fit the draft, and ask what it lacks."""
        if self.check():
            self.message = (
                "The draft cannot be fitted yet; correct the listed mistakes."
            )
            return
        self._fitting = self.draft.as_it_is()
        path = write_whole(self._state / FITTING_FILE, self._fitting.text)
        order = partial(worker.fit, path, self._fitting.places, self._origin)
        self._order("Fitting and diagnosing", order)

    def average(self, n: int) -> None:
        """Let the mean of so many samples stand for them, and fit that."""
        data = self.draft.data
        if data is None:
            return
        known = data.settings.get("thinned", 1)
        data.settings["thinned"] = n * (known if isinstance(known, int) else 1)
        self.shape += 1
        self.fit()

    def diagnose(self) -> None:
        self._order("Diagnosing", partial(worker.diagnose))

    def add(self, *effects: str) -> None:
        """Add an effect of the ranking, or all that are proposed; ask again."""
        said = " and ".join(effects)
        what = effects[0] if len(effects) == 1 else ""
        self._order(f"Adding {said} and diagnosing", partial(worker.add, what))

    def go_to(self, number: int) -> None:
        """Show a model that was fitted, and go on from it; nothing is lost."""
        if self.job is None:
            self.now = number
            self._compare_with_base()
            self._keep_moment()
            self.message = ""
            self.version += 1

    # ---- undo and redo ---------------------------------------------------------------

    def _keep_moment(self) -> None:
        """Note what was filled in or is shown now, where that has changed."""
        with self._checking:
            known = self._moments[self._moment]
            if known.draft != self.draft or known.model not in (None, self.now):
                del self._moments[self._moment + 1 :]
                self._moments = [*self._moments, known][-100:]  # to which undo goes
                self._moment = len(self._moments) - 1
            self._moments[self._moment] = Moment(deepcopy(self.draft), self.now)

    def can_step(self, by: int) -> bool:
        """Whether there is a change to undo (-1) or to do again (1)."""
        return self.job is None and 0 <= self._moment + by < len(self._moments)

    def step(self, by: int) -> str:
        """Undo the last change (-1), or do it again (1); which part it was in."""
        with self._checking:  # one step after the other, each with its check
            if not self.can_step(by):
                return ""
            known = self._moments[self._moment]
            self._moment += by
            moment = self._moments[self._moment]
            self.message = ""
            part = "study" if moment.draft.data == known.draft.data else "data"
            if moment.model not in (None, self.now):
                self.now = moment.model
                self._compare_with_base()
            if moment.draft != known.draft:
                part = "model" if part == "study" else part
                self.draft = deepcopy(moment.draft)
                self.version += 1  # the buttons, no later than the fields
                self.shape += 1
            self.check()
        return part

    def _compare_with_base(self) -> None:
        """Compare with the base model that the one shown came from."""
        self.compared = None
        if self.model is None:
            return
        for number, one in enumerate(self.models):
            is_base = len(one.content.steps) == 1 and number != self.now
            if is_base and one.drafted == self.model.drafted:
                self.compared = number

    def auto(self) -> None:
        self._order("Adding effects until none is missing", partial(worker.auto))

    def report(self, name: str = REPORT_FILE) -> None:
        """Write the report, or the model; ``report_path`` is set when it is there."""
        self.report_path = None
        what = "Writing the report" if name == REPORT_FILE else f"Writing {name}"
        self._order(what, partial(worker.report, self._state / name))

    def cancel(self) -> None:
        """End the work that goes on, within two seconds; what was found stays."""
        if self.job is None:
            return
        message = f"Cancelled: {self.job.label}. Results obtained before are kept."
        self._end_worker()
        self.message = message
        self._ready_worker()
        self.version += 1

    def _order(self, label: str, order: Order) -> None:
        with self._checking:  # of two threads one begins
            if self.job is not None or self.is_closed:
                return
            self.job = Job(order, label)
        self.message = ""
        self.failure = ""
        model = self.model if self._fitting is None else None
        self._ready_worker().tell(order, model.study if model else None)
        self.version += 1

    def _call(
        self, places: Mapping[str, Path] | None, read: Callable[..., Any], *given: Any
    ) -> Any:
        """What a function returns in the process that reads; None: files of our own."""
        with self._calling:
            if self.is_closed:
                raise DataError(HAS_ENDED)
            within = None
            if places is not None:
                known = filter(os.path.exists, places.values())
                size = sum(map(os.path.getsize, known))
                # A full check of a table takes some 2 s for each MB.
                within = READ_WITHIN + 10e-6 * size
            return self._ready_reader().call(within, partial(read, *given))

    def _ready_reader(self) -> WorkerHandle:
        if self._reader is None or not self._reader.process.is_alive():
            self._reader = WorkerHandle(self._receive, solves=False)
        self._idle_since = time.monotonic()
        return self._reader

    def _ready_worker(self) -> WorkerHandle:
        if self._worker is None or not self._worker.process.is_alive():
            self._worker = WorkerHandle(self._receive)
        self._idle_since = time.monotonic()
        return self._worker

    def _end_worker(self) -> None:
        ended = self._worker
        self._worker = None  # what it still says is not listened to
        self.job = None
        self._fitting = None
        if ended is not None:
            ended.end()

    def rest(self, after: float = 0.0) -> None:
        """End processes without work for so many seconds; an order starts others."""
        if self.job is not None or time.monotonic() - self._idle_since < after:
            return
        self._end_worker()
        if self._reader is not None and not self._calling.locked():
            self._reader.end()

    def _receive(self, sender: WorkerHandle, message: Any) -> None:
        """Take a message of the worker; called from its thread."""
        if sender is not self._worker:
            return
        if isinstance(message, str) and self.job is not None:
            self.job.take(message)
        elif isinstance(message, Shown):
            self._show(message)
            sender.study = self.model.study if self.model else None
        elif isinstance(message, Returned):
            self._end_job(message)
        elif message is None:  # it ended by itself, for want of memory perhaps
            if self.job is not None:
                self.message = (
                    f"The worker process ended unexpectedly ({self.job.label}). "
                    "Earlier results are kept; try again, with fewer samples if "
                    "memory is short."
                )
            self._end_worker()
        self.version += 1

    def _end_job(self, result: Returned) -> None:
        error = result.error
        if error is not None:
            self.message = self.failure = str(error)
            if isinstance(error, StudyFileError):
                self.message = self.failure = "The draft cannot be used yet."
                self.complaints = error.complaints
            self._checked = None
        elif isinstance(result.value, Path):
            self.report_path = result.value
        elif self.model is not None and self.now is not None:
            self.models[self.now] = replace(self.model, laws=result.value)
        self.job = None
        self._fitting = None
        self._idle_since = time.monotonic()

    def _show(self, shown: Shown) -> None:
        """Take a new model, or what is known now of the one that is shown."""
        # Charts of a base model open at the run that judges it. After a further step
        # they stay where they were: the reader compares before and after.
        content, known = shown.content, self.model
        drafted = self._fitting or (known.drafted if known else self.draft.as_it_is())
        is_fitted = self._fitting is not None  # the first result of a fit
        self._fitting = None
        n_known = len(known.content.steps) if known else 0
        if known is None or is_fitted or len(content.steps) > n_known:
            path = self._state / f"model_{len(self.models)}"
            path.write_bytes(shown.study)
            self.models.append(Model(content, path, drafted))
            self.now = len(self.models) - 1
            self._keep_moment()
            self._compare_with_base()
            if is_fitted:
                self.look = Look(content.shown, content.shown_channel)
        else:
            assert self.now is not None
            known.study.write_bytes(shown.study)
            self.models[self.now] = replace(known, content=content)

    # ---- files to take away ----------------------------------------------------------

    def study_file(self) -> StudyFile:
        """The study file as it was fitted, with the effects added."""
        if self.model is None:
            raise DataError("nothing has been fitted yet; press Fit first.")
        drafted = self.model.drafted
        path = write_whole(self._state / FITTED_FILE, drafted.text)
        content = self.model.content
        given = (path, drafted.places, content.added, content.hold)
        made: StudyFile = self._call(drafted.places, drafts.fitted_file, *given)
        return made

    def close(self) -> None:
        self.is_closed = True
        self._end_worker()
        if self._reader is not None:
            self._reader.end()
        shutil.rmtree(self.folder, ignore_errors=True)

"""The commands of ``phsi-opt``.

The libraries of the solver are imported by the commands that need them, so that help
and completion come at once.
"""

import signal
import sys
from importlib.metadata import version
from pathlib import Path
from types import FrameType
from typing import Annotated

import typer

from phsi_opt.command_line.job import (
    COMPARE,
    DIAGNOSE,
    EXPERIMENT,
    EXPORT,
    FIT,
    GO_THROUGH,
    MEANINGS,
    ExitCode,
    ExperimentPlan,
    Job,
    Reach,
)
from phsi_opt.command_line.process import do, finish, told_errors
from phsi_opt.data.file_opening import opened_files
from phsi_opt.export.targets import exported_path

STUDY_NAME = "study.toml"  # written by init, and read where no other is named
REPORT_NAME = "report.html"  # written by --report without a name
ALL_MODELS = "?"  # --model without a name
NAMELESS = {"--report": REPORT_NAME, "--model": ALL_MODELS}
LOOPBACK = "127.0.0.1"  # the page is for this machine alone, unless told otherwise

CODES = "\n\n".join(f"{code.value}: {said}" for code, said in MEANINGS.items())
app = typer.Typer(
    name="phsi-opt",
    help="Compare a model with measurements, find missing effects, add them, and see "
    "the error fall.\n\nStart with `phsi-opt demo`, or with your own table: "
    f"`phsi-opt init data.csv`.\n\nExit codes:\n\n{CODES}",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
)

StudyPath = Annotated[Path, typer.Argument(help="The study file.", metavar="STUDY")]
OwnStudy = Annotated[
    Path | None,
    typer.Argument(
        help=f"The study file; default: {STUDY_NAME}, if there is one.", metavar="STUDY"
    ),
]
AsJson = Annotated[
    bool, typer.Option("--json", help="Print one JSON object to standard output.")
]
Save = Annotated[
    Path | None, typer.Option(help="Save the fit in this file (JSON).", metavar="FILE")
]
Saved = Annotated[
    Path | None,
    typer.Option(
        "--fit", help="Use this saved fit instead of a new one.", metavar="FILE"
    ),
]
Missing = Annotated[
    bool,
    typer.Option(
        "--exit-code", help="Exit with code 1 if an effect or a force is missing."
    ),
]


def _own_study() -> Path | None:
    own = Path(STUDY_NAME)
    return own if own.is_file() else None


def _show_version(is_asked: bool) -> None:
    if is_asked:
        print(f"phsi_opt {version('phsi_opt')}")
        raise typer.Exit


@app.callback()
def options(
    is_version: Annotated[
        bool,
        typer.Option(
            "--version",
            callback=_show_version,
            is_eager=True,
            help="Show the version and exit.",
        ),
    ] = False,
) -> None:
    """Options before a command."""


@app.command()
def init(
    data: Annotated[
        list[Path] | None, typer.Argument(help="Data file(s): text, .xlsx, .mat, ...")
    ] = None,
    study: Annotated[
        Path, typer.Option("--study", "-o", help="Path of the new study file.")
    ] = Path(STUDY_NAME),
    model: Annotated[
        str | None,
        typer.Option(
            help="Begin with this base model, or that of a file (.toml: blocks, or a "
            "study file; .json: a saved fit); without a name: list all of them.",
            metavar="[NAME]",
        ),
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Overwrite an existing file.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Read a data file and write a first study file for it."""
    if not data and model != ALL_MODELS:
        raise typer.BadParameter("give the data file(s): phsi-opt init data.csv.")
    with told_errors(as_json):
        for _ in opened_files(data, as_text=False) if data else ():
            pass  # one that cannot be read is refused before the libraries are loaded
        from phsi_opt.command_line.file_jobs import first_study, gallery

        if model == ALL_MODELS:
            finish(gallery(), as_json)
        else:
            finish(first_study(data or [], study, force, model, not as_json), as_json)


@app.command()
def check(study: StudyPath = Path(STUDY_NAME), as_json: AsJson = False) -> None:
    """Check a study file, its data and its model; list all mistakes."""
    with told_errors(as_json, study):
        from phsi_opt.command_line.file_jobs import checked

        finish(checked(study, not as_json), as_json)


@app.command()
def fit(
    study: StudyPath = Path(STUDY_NAME), save: Save = None, as_json: AsJson = False
) -> None:
    """Estimate the parameters, with the effects added so far."""
    do(Job(FIT, study, save=save), as_json)


@app.command()
def compare(
    study: StudyPath = Path(STUDY_NAME), saved: Saved = None, as_json: AsJson = False
) -> None:
    """Compare a simulation of the fitted model with the held-out data."""
    do(Job(COMPARE, study, fit=saved), as_json)


@app.command()
def diagnose(
    study: StudyPath = Path(STUDY_NAME),
    saved: Saved = None,
    exit_code: Missing = False,
    as_json: AsJson = False,
) -> None:
    """Show where the model fails and which effect explains it."""
    do(Job(DIAGNOSE, study, fit=saved, exit_code=exit_code), as_json)


@app.command()
def export(
    file: Annotated[
        Path | None,
        typer.Argument(
            help="The new file: .fmu, .c, .mo (Modelica) or .m (MATLAB); of figures "
            "the folder, by default figures.",
            metavar="FILE",
        ),
    ] = None,
    study: StudyPath = Path(STUDY_NAME),
    saved: Saved = None,
    csv: Annotated[
        bool, typer.Option("--csv", help="Write the numbers of each figure.")
    ] = False,
    svg: Annotated[bool, typer.Option("--svg", help="Each figure as SVG.")] = False,
    png: Annotated[bool, typer.Option("--png", help="Each figure as PNG.")] = False,
    pdf: Annotated[bool, typer.Option("--pdf", help="Each figure as PDF.")] = False,
    as_json: AsJson = False,
) -> None:
    """Write the fitted model for other programs, or the figures of the report."""
    asked = {"csv": csv, "svg": svg, "png": png, "pdf": pdf}
    kinds = tuple(filter(asked.__getitem__, asked))
    if kinds and saved is not None:
        raise typer.BadParameter("--fit has no figures; leave it out.")
    if kinds:
        figures = file or Path("figures")
        do(Job(EXPORT, study, figures=figures, kinds=kinds), as_json)
    if file is None:
        raise typer.BadParameter(
            "name the file of the model, such as model.fmu, or a kind of figures: "
            "--csv, --svg, --png or --pdf."
        )
    with told_errors(as_json):
        exported_path(file)
    do(Job(EXPORT, study, fit=saved, export=file), as_json)


@app.command()
def add(
    effect: Annotated[
        str, typer.Argument(help='The effect, such as "coulomb friction".')
    ],
    study: StudyPath = Path(STUDY_NAME),
    equation: Annotated[
        str | None,
        typer.Option("--equation", "-e", help="The state in whose equation it acts."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Add an effect to the study file; your text and comments are kept."""
    with told_errors(as_json, study):
        from phsi_opt.command_line.file_jobs import add_effect

        finish(add_effect(study, effect, equation), as_json)


@app.command()
def effects(
    study: OwnStudy = None,
    everything: Annotated[
        bool, typer.Option("--all", help="List the effects of all fields.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """List the effects of the catalogue with equations and other names."""
    study = None if everything else study or _own_study()
    with told_errors(as_json, study):
        from phsi_opt.command_line.file_jobs import effects_of

        finish(effects_of(study), as_json)


@app.command(name="study")
def study_(
    study: StudyPath = Path(STUDY_NAME),
    auto: Annotated[
        bool,
        typer.Option("--auto", help="Find missing effects and add them, repeatedly."),
    ] = False,
    report: Annotated[
        Path | None,
        typer.Option(
            help=f"Write a report; the default name is {REPORT_NAME}.", metavar="[FILE]"
        ),
    ] = None,
    save: Save = None,
    max_steps: Annotated[
        int | None,
        typer.Option(min=1, help="Largest number of effects that --auto adds."),
    ] = None,
    reach: Annotated[
        Reach, typer.Option(help="Weakest evidence of effects that --auto adds.")
    ] = Reach.DECISIVE,
    write: Annotated[
        bool,
        typer.Option("--write", help="Write the added effects into the study file."),
    ] = False,
    exit_code: Missing = False,
    as_json: AsJson = False,
) -> None:
    """Run the steps of a study: the base model, then each added effect."""
    how = (auto, max_steps, save, report, exit_code, write, reach)
    do(Job(GO_THROUGH, study, None, *how), as_json)


@app.command()
def experiment(
    study: StudyPath = Path(STUDY_NAME),
    limit: Annotated[
        list[str] | None,
        typer.Option(
            help="Lower and upper limit of an input, a state, or the duration t, in "
            "the units of the data; repeatable. Default: the range of the data.",
            metavar="NAME=LOWER:UPPER",
        ),
    ] = None,
    start: Annotated[
        list[str] | None,
        typer.Option(
            help="Where a state starts; repeatable. Default: as in the data.",
            metavar="NAME=VALUE",
        ),
    ] = None,
    sharpen: Annotated[
        str | None,
        typer.Option(help="The parameter whose standard error is to fall."),
    ] = None,
    table: Annotated[
        Path, typer.Option("--table", "-o", help="The table of times and inputs.")
    ] = Path("experiment.csv"),
    as_json: AsJson = False,
) -> None:
    """Design the experiment that distinguishes effects or sharpens a parameter."""
    plan = ExperimentPlan(table, tuple(limit or ()), tuple(start or ()), sharpen)
    do(Job(EXPERIMENT, study, plan=plan), as_json)


@app.command()
def page(
    study: OwnStudy = None,
    host: Annotated[str, typer.Option(help="Address of the server.")] = LOOPBACK,
    port: Annotated[int, typer.Option(help="Port of the server.")] = 8080,
    show: Annotated[bool, typer.Option(help="Open a browser.")] = True,
) -> None:
    """Open a study in the browser."""
    with told_errors():
        from phsi_opt.page.serve import serve

        serve(study or _own_study(), host=host, port=port, show=show)


@app.command()
def demo(
    folder: Annotated[Path, typer.Argument(help="Folder for its files.")] = Path(
        "phsi_opt_demo"
    ),
    as_json: AsJson = False,
) -> None:
    """Run an example: a damped spring with hidden friction (one minute)."""
    with told_errors(as_json):
        from phsi_opt.command_line.file_jobs import written_demonstration

        study = written_demonstration(folder)
    typer.echo(f"the study file: {study}", err=True)
    job = Job(GO_THROUGH, study, is_auto=True, report=folder / REPORT_NAME)
    do(job, as_json)


def with_names(arguments: list[str]) -> list[str]:
    """The arguments with what ``--report`` and ``--model`` mean without a name."""
    completed = []
    for argument, following in zip(arguments, [*arguments[1:], "-"], strict=True):
        completed.append(argument)
        if argument in NAMELESS and following.startswith("-"):
            completed.append(NAMELESS[argument])
    return completed


def main() -> None:
    """The entry point ``phsi-opt``."""
    signal.signal(signal.SIGTERM, _interrupt)
    try:
        app(with_names(sys.argv[1:]))
    except KeyboardInterrupt:
        typer.echo("stopped.", err=True)
        sys.exit(int(ExitCode.INTERRUPTED))


def _interrupt(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt

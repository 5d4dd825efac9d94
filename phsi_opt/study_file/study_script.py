"""The Python script that does what a study file says, step by step.

It is written from the records, in the names that users import, and looks for the data
beside itself.
"""

from collections.abc import Mapping, Sequence
from dataclasses import MISSING, fields
from typing import Any

import numpy as np

from phsi_opt.model.effect import Effect
from phsi_opt.model.model import Model
from phsi_opt.model.parameters import Parameter
from phsi_opt.model.slots import BY_EQUATION
from phsi_opt.model.terms import Dictionary, Term
from phsi_opt.study_file.content import loss_content, shared_parameters
from phsi_opt.study_file.effect_reading import StudySection
from phsi_opt.study_file.python_text import Call, Code, Names, source_of
from phsi_opt.study_file.sections import DataSection, HeldOut
from phsi_opt.transcription.losses import MaximumLikelihood

IN_SCRIPT = "parameters"  # the variable in which the script keeps them


def study_script(
    data: DataSection,
    held_out: HeldOut | None,
    model: Model,
    own_effects: Sequence[Effect],
    study: StudySection,
    loss: MaximumLikelihood,
) -> str:
    """The whole script.

    Raises:
        ModelError: a part has something that a study file cannot hold.
    """
    names = Names()
    body = [
        "FOLDER = Path(__file__).parent  # the data lie beside this script",
        *_data_lines(data),
        *_held_out_lines(held_out, names),
        *_model_lines(model, own_effects, names),
        *_own_effect_lines(own_effects, names),
        *_study_lines(model, own_effects, study, loss),
        "",
        "print(study.fit)",
        "print(study.compare())",
        "print(study.history)",
    ]
    head = [
        '"""A study of phsi_opt, as a script."""',
        "",
        "from pathlib import Path",
        "",
    ]
    return "\n".join([*head, "import phsi_opt as ph", *names.imports(), "", *body, ""])


def _data_lines(data: DataSection) -> list[str]:
    files: Any = [Code(f"FOLDER / {source_of(file)}") for file in data.files]
    first = files[0] if len(files) == 1 else files
    call = Call(f"ph.Measurements.{data.reader}", [first], data.reader_arguments())
    lines = [f"data = {call.text()}"]
    if data.between is not None:
        begin, end = data.between
        lines.append(f"data = data.between({begin!r}, {end!r})")
    if data.thinned is not None:
        lines.append(f"data = data.thinned({data.thinned})")
    return lines


def _held_out_lines(held_out: HeldOut | None, names: Names) -> list[str]:
    if held_out is None:
        return ["train, held_out = data, None", ""]
    if held_out.share is not None:
        return [f"train, held_out = data.split({held_out.training_share!r})", ""]
    names.ask("phsi_opt.study_file.sections", "HeldOut")
    which: dict[str, Any] = {"after": held_out.after}
    if held_out.runs is not None:
        which = {"runs": held_out.runs}
    call = Call("HeldOut", [], which)
    return [f"train, held_out = {call.text()}.split(data)", ""]


def _model_lines(
    model: Model, own_effects: Sequence[Effect], names: Names
) -> list[str]:
    lines = []
    parameters = shared_parameters(model, own_effects)
    if parameters:
        table = {name: _parameter(one, names) for name, one in parameters.items()}
        lines = [f"{IN_SCRIPT} = {Call('dict', [], table).text()}"]
    arguments: dict[str, Any] = {"states": list(model.states)}
    if model.inputs:
        arguments["inputs"] = list(model.inputs)
    if model.has_energy:
        arguments["S"] = np.array(model.S).tolist()
        arguments["H"] = _terms(model.H, names)
    for slot in BY_EQUATION:
        by_equation = getattr(model, slot)
        if by_equation or (slot == "F" and not model.has_energy):
            arguments[slot] = {n: _terms(ts, names) for n, ts in by_equation.items()}
    if model.memory:
        arguments["memory"] = list(model.memory)
    if model.kind:
        arguments["kind"] = dict(model.kind)
    name = "ph.PseudoHamiltonian" if model.has_energy else "ph.FirstOrder"
    return [*lines, f"model = {Call(name, [], arguments).text()}", ""]


def _parameter(parameter: Parameter, names: Names) -> Any:
    """A parameter as code: a plain number where it is known and nothing else."""
    arguments = _changed_fields(parameter)
    if set(arguments) == {"value", "fixed"}:
        return parameter.value
    if parameter.guess is not None:
        kind = type(parameter.guess).__name__
        names.ask("phsi_opt.model.parameters", kind)
        arguments["guess"] = Call(kind, [], _changed_fields(parameter.guess))
    return Call("ph.Parameter", [], arguments)


def _changed_fields(record: Any) -> dict[str, Any]:
    """Fields whose values are not the default."""
    changed = {}
    for one in fields(record):
        value = getattr(record, one.name)
        if one.default is MISSING or value != one.default:
            changed[one.name] = value
    return changed


def _terms(terms: Dictionary, names: Names) -> Any:
    """A sum of terms; formulas and other terms, each joined by a plus."""
    parts = []
    for term in terms:
        parts.append(_formula(term) if term.is_formula else _dictionary(term, names))
    if len(parts) == 1:
        return parts[0]
    return Code(" + ".join(part.text() for part in parts) or 'ph.formula("0")')


def _formula(term: Term) -> Call:
    arguments: Mapping[str, Any] = {
        name: Code(f"{IN_SCRIPT}[{source_of(name)}]") for name in term.inner
    }
    return Call("ph.formula", [term.body], arguments)


def _dictionary(term: Term, names: Names) -> Call:
    names.ask("phsi_opt.model.terms", "Dictionary")
    names.ask("phsi_opt.model.terms", "Term")
    coefficient = term.coefficient or Parameter()
    arguments: dict[str, Any] = {
        "body": term.body,
        "coefficient": _free(coefficient, names),
    }
    if term.inner:
        arguments["inner"] = {n: _free(p, names) for n, p in term.inner.items()}
    if term.name:
        arguments["name"] = term.name
    one = Call("Term", [], arguments)
    return Call("Dictionary", [Code(f"({one.text()},)")], {})


def _free(parameter: Parameter, names: Names) -> Any:
    """A parameter where no plain number may stand."""
    written = _parameter(parameter, names)
    if isinstance(written, Call):
        return written
    return Call("ph.Parameter", [parameter.value], {"fixed": True})


def _own_effect_lines(own_effects: Sequence[Effect], names: Names) -> list[str]:
    if not own_effects:
        return []
    calls = []
    for effect in own_effects:
        arguments: dict[str, Any] = {
            "name": effect.name,
            "slot": effect.slot,
            "equation": effect.equation,
            "term": _terms(effect.term, names),
        }
        if effect.memory:
            arguments["memory"] = {
                name: _terms(terms, names) for name, terms in effect.memory.items()
            }
        if effect.family:
            arguments["family"] = effect.family
        calls.append(Call("ph.Effect", [], arguments))
    table = {str(effect): call for effect, call in zip(own_effects, calls, strict=True)}
    return [f"own = {Code.of(table).text()}", ""]


def _study_lines(
    model: Model,
    own_effects: Sequence[Effect],
    study: StudySection,
    loss: MaximumLikelihood,
) -> list[str]:
    arguments: dict[str, Any] = {"held_out": Code("held_out")}
    lines = []
    own = {}
    for effect in own_effects:
        own[effect.name] = str(effect)
        own[str(effect)] = str(effect)
    if study.effects is not None:
        effects: list[Any] = []
        for name in study.effects:
            effects.append(_chosen(name, own))
        arguments["effects"] = effects
    elif own_effects:
        lines.append("catalogue = map(str, ph.catalogue(model, data.units))")
        arguments["effects"] = Code("[*catalogue, *own.values()]")
    if study.without:
        arguments["without"] = list(study.without)
    settings = loss_content(loss)
    if settings:
        arguments["loss"] = Call("ph.MaximumLikelihood", [], settings)
    arguments["progress"] = Code("print")
    call = Call("ph.Study", [Code("model"), Code("train")], arguments)
    lines.append(f"study = {call.text()}")
    for name in study.added:
        lines.append(_added(name, own, model))
    return lines


def _chosen(name: str, own: Mapping[str, str]) -> Any:
    """An effect to consider: one of the user's own, or a name of the catalogue."""
    return Code(f"own[{source_of(own[name])}]") if name in own else name


def _added(name: str, own: Mapping[str, str], model: Model) -> str:
    if name in own:
        return f"study.add(own[{source_of(own[name])}])"
    before, _, equation = name.rpartition(" on ")
    if before and equation in model.states:
        return f"study.add({source_of(before)}, {source_of(equation)})"
    return f"study.add({source_of(name)})"

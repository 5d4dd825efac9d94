"""Where a model fails, and which effect is missing.

1. The missing force along every trajectory, with the states it implies.
2. The model is weighed beside that force: how likely are the measurements?
3. Every effect of the catalogue is screened by the slope of that evidence; those that
   may raise it are weighed beside the force that they leave. Where none explains what
   is missing, unknown functions of one quantity are.
4. The verdict: an effect whose evidence is decisive is named, with those that the data
   do not tell from it, and re-fitted; whether a force remains beside it is said.
"""

from collections.abc import Sequence
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import replace

from phsi_opt.arguments import typed
from phsi_opt.comparison.compare import Comparison, compare
from phsi_opt.data.copies import check_can_judge
from phsi_opt.data.measurements import Measurements
from phsi_opt.diagnosis.candidate import Candidate
from phsi_opt.diagnosis.conclusion import concluded, without_evidence
from phsi_opt.diagnosis.ranking import ranked, weighed_of
from phsi_opt.diagnosis.record import Diagnosis
from phsi_opt.diagnosis.refit import DiagnosedModel, held_base, refit
from phsi_opt.errors import ModelError, SolveError
from phsi_opt.estimation.fit import Fit
from phsi_opt.estimation.identify import fit_of
from phsi_opt.interrupts import interruptible
from phsi_opt.model.catalogue import EffectChoice, Given
from phsi_opt.model.effect import Effect
from phsi_opt.model.model import Model
from phsi_opt.sweeps.sweep import Progress, silent
from phsi_opt.transcription.grid import aligned_once
from phsi_opt.transcription.losses import MaximumLikelihood


@typed
@interruptible
def diagnose(
    fit: Fit | Model,
    data: Measurements,
    held_out: Measurements | None = None,
    *,
    effects: Given | None = None,
    without: Given = (),
    kinds: Sequence[str] | None = None,
    loss: MaximumLikelihood | None = None,
    progress: Progress | None = None,
    executor: Executor | None = None,
) -> Diagnosis:
    """Estimate the force that a fitted model lacks, and name it if the data allow it.

    Args:
        fit: of the model, by maximum likelihood; or a model whose parameters are all
            known, which then stay as they are.
        data: the measurements of the fit.
        held_out: measurements not used for fitting; without them the verdict depends on
            the training data only.
        effects: candidates, each an `Effect`, a name such as ``"coulomb friction"``
            (in every equation that can have it) or ``"coulomb friction on p"``;
            default: `catalogue` of the model.
        without: effects to exclude, in the same form.
        kinds: which of "catalogue" (effects in one equation), "couplings" (between two
            states), "storages" (that nobody measures) and "functions" (unknown ones of
            one quantity, asked where no effect explains what is missing) are
            candidates; default: all, without functions where ``effects`` are given.
        loss: how candidates are re-fitted; default `MaximumLikelihood`. A random force
            in the equations (``model_error=True``) would hide a missing force; it is
            omitted, and a fit with such a force is repeated without it.
        progress: called with a line of text about the progress, such as ``print``.
        executor: computes the evidence of candidates in parallel (see `sweep`); None:
            in this process, one after the other. The verdict and its numbers are the
            same. It is not shut down.

    Returns:
        Where the model fails, the candidates in order, and the verdict.

    Raises:
        DataError: a state or input of the model is not in the measurements, a run that
            is held out is fitted too, or the executor is not valid.
        ModelError: one of the ``effects`` or of those to leave out is unknown, does not
            apply to the model, or has no free parameter; or a model with free
            parameters was given instead of a fit.
        SolveError: the missing force could not be estimated.

    Examples:
        >>> found = ph.diagnose(ph.identify(model, train), train, held_out=test)
        >>> print(found.verdict)
        missing: named
        >>> print(found.findings[0])
        coulomb friction in the equation of p (1.98 +- 0.14 N)
    """
    say = progress or silent
    say("estimating what is missing")
    fit = fit_of(fit, data, "diagnose")
    among = None if kinds is None else tuple(kinds)
    choice = EffectChoice(effects, without, among).checked(fit.model, data.units)
    trained = compare(fit, data)
    judged = None
    if held_out is not None:
        check_can_judge(trained.data, aligned_once(fit.model, held_out))
        judged = compare(fit, held_out)
    return diagnose_comparison(
        trained, judged, choice=choice, loss=loss, progress=say, executor=executor
    )


def diagnose_comparison(
    trained: Comparison,
    judged: Comparison | None,
    *,
    choice: EffectChoice,
    loss: MaximumLikelihood | None,
    progress: Progress,
    executor: Executor | None,
) -> Diagnosis:
    """`diagnose` for a fit that was compared before.

    Nothing of the comparisons is computed again.

    Raises:
        ModelError: one of the effects does not fit the model, or has no free number.
    """
    base = DiagnosedModel.of(trained, judged, loss, progress, executor)
    effects = choice.candidates(base.fit.model, base.record.data.units)
    _check_effects(effects, base.fit.model)
    base.say("estimating what is missing together with the model")
    try:
        record = base.evidence_record()
    except SolveError as error:
        return without_evidence(base, error)
    found = concluded(base, record, effects, choice.has_functions)
    held = held_base(base, record, found.established)
    if held is None:
        return found
    found = concluded(held, held.evidence_record(), effects, choice.has_functions)
    return replace(found, reason=f"{held.record.aligned.notes[0]}; {found.reason}")


def candidate_of(
    trained: Comparison, effect: Effect, loss: MaximumLikelihood
) -> Candidate | None:
    """One effect, weighed and re-fitted whatever its evidence.

    None where it leaves no trace in the record; without a re-fit where that failed.

    Raises:
        ModelError: the effect does not fit the model, or has no free number.
    """
    _check_effects([effect], trained.fit.model)
    base = DiagnosedModel.of(trained, None, loss)
    ranking = ranked(base, base.evidence_record(), [effect])
    one = ranking.screened.get(str(effect))
    if one is None:
        return None
    if not ranking.weighed:
        with suppress(SolveError):
            ranking.take(base, one, weighed_of(ranking.record, one, base.say))
    found = ranking.candidates[0]
    larger = refit(base, found)
    return found if larger is None else replace(found, fit=larger.fit)


def _check_effects(effects: list[Effect], model: Model) -> None:
    """Refuse an effect that no fit could find."""
    for effect in effects:
        if set(model.add(effect).free) <= model.entries.keys():
            raise ModelError(
                f"effect {str(effect)!r} has no free parameter, so its size cannot be "
                "estimated; write a number in it as ph.Parameter(), such as "
                'ph.formula("c*q", c=ph.Parameter()).'
            )

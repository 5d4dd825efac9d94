"""Where a model fails, and which effect is missing.

1. The missing force along every trajectory, with the states it implies (`missing`).
2. Every effect of the catalogue is screened on the whole record without re-fitting
    (`screen`).
3. The best few, and where one is not enough the best pairs, are re-fitted by maximum
   likelihood and judged by BIC, with correlated residuals counted for the independent
   ones they are worth, and by the free run on data held out.
4. The verdict: an effect is named when it is significant (false-discovery rate over all
   candidates), when the held-out error falls, and when it, alone or with one more,
   leaves residuals like noise. Effects that explain most of what is missing but leave
   more than noise are proposed, and the verdict says that something remains
   unexplained.
"""

from collections.abc import Callable

from phsi_opt.data.measurements import Measurements
from phsi_opt.diagnosis.ranking import adjusted, candidate_of
from phsi_opt.diagnosis.record import Diagnosis
from phsi_opt.diagnosis.refit import Refitting
from phsi_opt.estimation.fit import Fit
from phsi_opt.model.catalogue import catalogue
from phsi_opt.model.effect import Effect
from phsi_opt.screening.score_test import Screen
from phsi_opt.transcription.alignment import aligned
from phsi_opt.transcription.losses import MaximumLikelihood


def diagnose(
    fit: Fit,
    data: Measurements,
    held_out: Measurements | None = None,
    *,
    effects: list[Effect] | None = None,
    loss: MaximumLikelihood | None = None,
    progress: Callable[[str], None] | None = None,
) -> Diagnosis:
    """Estimate what the fitted model lacks on ``data`` and name it, if the data allow
    (see the module's text).

    Args:
        held_out: measurements not used for fitting; without them the verdict rests on
            the training record alone.
        effects: candidates; default: `catalogue` of the model. loss: how candidates are
            re-fitted.
        progress: called with a line of text as the work goes on.
    """
    say = progress or (lambda line: None)
    data = aligned(fit.model, data)
    say("estimating the missing force")
    work = Refitting.begin(fit, data, held_out, loss or MaximumLikelihood(), say)
    listed = catalogue(fit.model) if effects is None else effects
    say(f"screening {len(listed)} candidate effects")
    screen = Screen(fit, data, work.estimate, work.trained.simulated)
    found = screen.screened(listed)
    candidates = [candidate_of(one, found, screen) for one in found]
    refitted = work.best_of(screen, found, candidates)
    tried = [c.effect for c in refitted]
    everyone = adjusted(refitted + [c for c in candidates if c.effect not in tried])
    failed = [c.effect for c in refitted if c.fit is None]
    proposal = work.proposed(
        screen, [one for one in found if one.effect not in failed], everyone
    )
    if proposal is not None:
        everyone = tuple(
            sorted(everyone, key=lambda c: c.effect not in proposal.effects)
        )
    verdict, reason, named = work.verdict(proposal)
    nearest = proposal.fit if proposal is not None and named else None
    return Diagnosis(
        fit, data, work.estimate, work.base, everyone, verdict, reason, named, nearest
    )

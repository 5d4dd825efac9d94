"""Re-fits of one round, begun side by side where there is an executor.

A round holds re-fits that do not begin at each other. What those before a re-fit found
may still say whether dry friction is worth a sharp corner (`RefitRequest.rival`); that
is left to its turn. So what comes out is what one after the other would give, to the
bit.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from types import TracebackType
from typing import Self

from phsi_opt.diagnosis.diagnosed_model import DiagnosedModel
from phsi_opt.diagnosis.dry_friction import is_dry
from phsi_opt.diagnosis.refit import (
    Refit,
    RefitRequest,
    is_worth_sharpening,
    refit,
    refitted,
)
from phsi_opt.errors import PhsiOptError
from phsi_opt.estimation.problem import Progress, silent
from phsi_opt.sweeps.ahead import Ahead


class RefitRound:
    """Re-fits that are asked for in their turn; leaving it cancels the others."""

    def __init__(self, base: DiagnosedModel, begun: Mapping[int, RefitRequest]) -> None:
        """Begin re-fits by place, with what is known before the round.

        Args:
            base: the model that is diagnosed; without an executor nothing is begun.
            begun: re-fits that do not begin at one another; one alone waits for its
                turn.
        """
        self._base = base
        is_alone = base.executor is None or len(begun) < 2
        self._begun = {} if is_alone else dict(begun)
        of_workers = replace(base, say=silent, executor=None)
        cases = {str(place): request for place, request in self._begun.items()}
        self._ahead = Ahead(
            partial(_refitted, of_workers), cases, base.executor, base.say
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._ahead.close()

    def refit(self, place: int, request: RefitRequest) -> Refit | None:
        """The re-fit of a place, with all that is known in its turn; None: it failed.

        Once for a place.
        """
        base = self._base
        if place not in self._begun:
            return refit(base, request)
        is_final = self._begun[place].sharpens
        try:
            done = self._ahead.result(str(place)).beside(base)
        except PhsiOptError as error:
            if not is_final:
                return refit(base, request)
            base.say(f"not re-fitted: {error}")
            return None
        blunt = done.before_sharpening
        if is_final or blunt is None or not is_worth_sharpening(base, request, blunt):
            return done
        return refit(base, request, blunt)


def until_their_turn(requests: Mapping[int, RefitRequest]) -> dict[int, RefitRequest]:
    """The re-fits of a round in which each is a rival of those after it.

    Of dry friction the first alone is sharpened before its turn: the rival that it must
    beat is known.
    """
    begun: dict[int, RefitRequest] = {}
    for place, request in requests.items():
        is_smooth = not any(is_dry(effect) for effect in request.effects)
        begun[place] = replace(request, sharpens=not begun or is_smooth)
    return begun


def _refitted(base: DiagnosedModel, request: RefitRequest, say: Progress) -> Refit:
    return refitted(replace(base, say=say), request)

"""Effects of a sensor: offset, gain, drift, clipping and delay of what it shows.

They leave the motion as it is: measured = state + sensor terms.
"""

from phsi_opt.model.catalogue_parts import (
    LARGEST_SHARE,
    LIMITS,
    Delay,
    one_term,
    tried,
    underscored,
)
from phsi_opt.model.effect import Effect
from phsi_opt.model.terms import formula

WRONG_READING = "an error of the sensor"
LATE_READING = "a delay of the sensor"


def sensors(state: str) -> list[Effect]:
    """What the sensor of a state may add to it."""
    return [
        _linear("sensor offset", state, "1"),
        _linear("sensor gain", state, state),
        _linear("sensor drift", state, "t"),
        _clipping(state),
        _delay(state),
    ]


def _linear(kind: str, state: str, body: str) -> Effect:
    term = one_term(body, f"{underscored(kind)}_{state}")
    return Effect(kind, "sensor", state, term, family=WRONG_READING)


def _clipping(state: str) -> Effect:
    limit = f"clipping_{state}"
    body = f"min(max({state}, -{limit}), {limit}) - {state}"
    inner = {limit: tried(state, LIMITS, LARGEST_SHARE)}
    term = formula(body, **inner)
    return Effect("sensor clipping", "sensor", state, term, family=WRONG_READING)


def _delay(state: str) -> Effect:
    delay = Delay(state, f"sensor_delay_{state}", f"{state}_delayed")
    change = delay.change()
    return Effect("sensor delay", "sensor", state, change, delay.memory(), LATE_READING)

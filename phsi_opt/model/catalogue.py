"""The catalogue of physical effects: a named phenomenon is a term in a slot of an
equation.

Velocities are the efforts dH/dp of a momentum, levels the efforts of a storage, u the
inputs. What is scanned before it is optimised (a Stribeck speed, a play, a delay)
carries the values to try as its guess.
"""

from collections.abc import Iterator
from itertools import combinations

import casadi as ca
import numpy as np

from phsi_opt.errors import ModelError, did_you_mean
from phsi_opt.model.effect import Effect, is_scanned
from phsi_opt.model.expressions import names_of
from phsi_opt.model.model import FirstOrder, Model
from phsi_opt.model.parameters import Parameter, Scan, Share, Tried
from phsi_opt.model.structure import (
    flow_states,
    forced_rows,
    position_of_momentum,
    storage_states,
)
from phsi_opt.model.terms import Dictionary, Term

# Dry friction turns over within this share of the typical velocity: sharp beside the
# motion, smooth for the solver. The fourth powers make its plateau flat, so that the
# share costs no friction at the velocities beyond it.
TURNOVER = 0.06
SHARPER = (0.25,) * 3  # the turnover is then made sharper, where that fits better
SLOW = 0.02  # share of the typical velocity within which a hysteresis is rounded
SMALL_LEVEL = (
    0.01  # share of the typical level below which a turbulent leak turns laminar
)
SPEEDS = (0.05, 0.1, 0.2, 0.3, 0.45)  # of the largest velocity: Stribeck
PLAYS = (
    0.1,
    0.2,
    0.35,
    0.5,
    0.65,
    0.8,
    0.9,
)  # of the largest position: play, yield, clipping
WIDTHS = (
    0.05,
    0.1,
    0.2,
    0.4,
)  # of the largest position: displacement over which a hysteresis yields
LEVELS = (
    0.5,
    0.6,
    0.7,
    0.8,
    0.88,
    0.94,
    0.97,
)  # of the largest level or value: overflow, clipping
DEAD_ZONES = (
    0.005,
    0.01,
    0.02,
    0.04,
    0.08,
    0.15,
    0.25,
    0.4,
    0.6,
    0.8,
)  # of the largest input
SATURATIONS = (0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 0.95, 0.98)  # of the largest input
ALL = 1.0  # of the largest value: no rim, play or limit beyond it does anything
# the same for the speed over which Stribeck's friction falls: beyond it is Coulomb's
MUCH = 3.0
DELAYS = (
    0.25,
    0.5,
    1.0,
    2.0,
    3.0,
    5.0,
    8.0,
    13.0,
    21.0,
    34.0,
    55.0,
    89.0,
    144.0,
    233.0,
)  # of times between samples


def catalogue(model: Model) -> list[Effect]:
    """The effects that apply to the model, each with the slot and equation it acts in;
    those it has are left out.
    """
    moved_by = position_of_momentum(model)
    effects: list[Effect] = []
    for i in forced_rows(model):
        name = model.states[i]
        effects += (
            _losses(model, name, moved_by.get(name))
            + _forces(model, name)
            + _actuators(model, name)
        )
        if name in moved_by:
            effects += [
                *_energies(moved_by[name], name),
                _parametric(model, moved_by[name], name),
            ]
            effects.append(_hysteresis(moved_by[name], name))
    stores = storage_states(model)
    effects += [
        _spilled(model, source, name)
        for source in stores
        for name in stores
        if name != source
    ]
    for (p1, q1), (_, q2) in combinations(moved_by.items(), 2):
        body = f"({q1} - {q2})**2/2"
        effects.append(
            Effect(
                "coupling stiffness",
                "H",
                p1,
                _term(body, f"coupling_stiffness_{q1}_{q2}"),
            )
        )
    effects += [
        effect
        for name in model.states
        if name not in model.memory
        for effect in _sensors(name)
    ]
    return [effect for effect in effects if not _is_in(model, effect)]


def effect_named(model: Model, name: str, equation: str) -> Effect:
    """The catalogue's effect of that name on that equation; raises `ModelError` with
    the nearest name otherwise.
    """
    model.index(equation, f"equation of effect {name!r}:")
    listed = catalogue(model)
    for effect in listed:
        if effect.name == name and effect.equation == equation:
            return effect
    names = sorted({effect.name for effect in listed if effect.equation == equation})
    raise ModelError(
        f"effect {name!r} on {equation!r} is not in the catalogue of this model (or the model has it already); "
        f"available there: {', '.join(names)}.{did_you_mean(name, names)}"
    )


def _term(
    body: str,
    name: str,
    inner: dict[str, Parameter] | None = None,
    lower: float = -np.inf,
) -> Dictionary:
    return Dictionary((Term(body, Parameter(None, lower=lower), inner or {}, name),))


def _tried(
    of: str, shares: tuple[float, ...], most: float = np.inf, unit: str = ""
) -> Parameter:
    return Parameter(None, lower=0.0, unit=unit, guess=Tried(of, shares, most))


def _losses(model: Model, name: str, position: str | None) -> list[Effect]:
    """R_ii(x) >= 0; the loss is R_ii dH/dx_i, so a force c f(v) against the velocity v
    has R = c f(v)/v.
    """
    v = name if isinstance(model, FirstOrder) else f"dH_d{name}"
    turnover = Parameter(None, lower=0.0, fixed=True, guess=Share(v, TURNOVER, SHARPER))
    dry = f"({v}**4 + v0**4)**(-0.25)"

    def loss(kind: str, body: str, inner: dict[str, Parameter] | None = None) -> Effect:
        return Effect(
            kind,
            "R",
            name,
            _term(body, f"{kind.replace(' ', '_')}_{name}", inner, lower=0.0),
        )

    is_storage = position is None and name not in flow_states(model)
    effects = [
        loss("linear leak" if is_storage else "viscous damping", "1"),
        loss("coulomb friction", dry, {"v0": turnover}),
        loss("quadratic drag", f"abs({v})"),
        loss("cubic drag", f"{v}**2"),
        _stribeck(model, name, v, dry, turnover),
    ]
    if position is not None:
        return [*effects, loss("position-dependent damping", f"{position}**2")]
    small = Parameter(None, lower=0.0, fixed=True, guess=Share(v, SMALL_LEVEL))
    over = f"max(abs({v}) - limit, 0)/max(abs({v}), limit)"
    leaks = [
        loss("turbulent leak", f"({v}**2 + e0**2)**(-0.25)", {"e0": small}),
        loss(
            "saturating leak",
            f"1/(1 + abs({v})/half)",
            {"half": _tried(v, (0.03, 0.1, 0.3, 1.0))},
        ),
        loss("overflow", over, {"limit": _tried(v, LEVELS, ALL)}),
    ]
    return [e for e in effects if not is_storage or e.name == "linear leak"] + leaks


def _spilled(model: Model, source: str, name: str) -> Effect:
    """What overflows from one storage runs into another one."""
    level = source if isinstance(model, FirstOrder) else f"dH_d{source}"
    body = f"max({level} - limit, 0)"
    term = _term(
        body,
        f"overflow_{source}_{name}",
        {"limit": _tried(level, LEVELS, ALL)},
        lower=0.0,
    )
    return Effect(f"overflow from {source}", "F", name, term)


def _stribeck(model: Model, name: str, v: str, dry: str, turnover: Parameter) -> Effect:
    """Dry friction that is larger at low speed: f_c + f_s exp(-(v/v_s)^2), against the
    velocity.
    """
    speed = _tried(v, SPEEDS, MUCH)
    more = Term(
        f"{dry}*exp(-({v}/v_s)**2)",
        Parameter(None, lower=0.0),
        {"v0": turnover, "v_s": speed},
        f"stribeck_friction_{name}",
    )
    level = Term(
        dry, Parameter(None, lower=0.0), {"v0": turnover}, f"coulomb_friction_{name}"
    )
    has_level = any(term.body == dry for term in model.R.get(name, Dictionary()))
    return Effect(
        "stribeck friction",
        "R",
        name,
        Dictionary((more,) if has_level else (level, more)),
    )


def _energies(q: str, p: str) -> list[Effect]:
    def energy(
        kind: str,
        body: str,
        inner: dict[str, Parameter] | None = None,
        lower: float = -np.inf,
    ) -> Effect:
        return Effect(
            kind, "H", p, _term(body, f"{kind.replace(' ', '_')}_{q}", inner, lower)
        )

    return [
        energy("linear stiffness", f"{q}**2/2"),
        energy("quadratic stiffness", f"{q}**3/3"),
        energy("cubic stiffness", f"{q}**4/4"),
        energy("gravity torque", f"-cos({q})"),
        energy(
            "gap", f"max(abs({q}) - play, 0)**2/2", {"play": _tried(q, PLAYS, ALL)}, 0.0
        ),
    ]


def _frequency(model: Model, kind: str, p: str) -> tuple[str, dict[str, Parameter]]:
    """A free frequency for waves in F of p, under a name that is not taken."""
    omega = "omega"
    while any(
        f"{kind}_{wave}_{p}.{omega}" in model.entries for wave in ("sin", "cos")
    ) or (f"F_{p}.{omega}" in model.entries):
        omega += "_"
    return omega, {omega: Parameter(None, lower=0.0, unit="rad/s", guess=Scan("t"))}


def _forces(model: Model, p: str) -> list[Effect]:
    omega, inner = _frequency(model, "harmonic", p)
    waves = tuple(
        Term(f"{wave}({omega}*t)", Parameter(), inner) for wave in ("sin", "cos")
    )
    return [
        Effect("constant force", "F", p, _term("1", f"constant_force_{p}")),
        Effect("drifting force", "F", p, _term("t", f"drifting_force_{p}")),
        Effect("harmonic force", "F", p, Dictionary(waves)),
    ]


def _parametric(model: Model, q: str, p: str) -> Effect:
    """A stiffness that changes with the time: -q (a sin(omega t) + b cos(omega t))."""
    omega, inner = _frequency(model, "parametric", p)
    waves = tuple(
        Term(f"-{q}*{wave}({omega}*t)", Parameter(), inner) for wave in ("sin", "cos")
    )
    return Effect("parametric stiffness", "F", p, Dictionary(waves))


def _hysteresis(q: str, p: str) -> Effect:
    """Bouc-Wen with n = 1: force -c z, w dz/dt = v - (|v| z + v |z|)/2, so that z stays
    within -1 and 1.

    The absolute values are rounded, that of the velocity within a small share of its
    typical size.
    """
    v, z, width, slow = (
        f"dH_d{p}",
        f"hysteresis_{p}",
        f"hysteresis_width_{p}",
        f"hysteresis_slow_{p}",
    )
    rate = (
        f"({v} - (sqrt({v}**2 + {slow}**2)*{z} + {v}*sqrt({z}**2 + 0.0025))/2)/{width}"
    )
    inner = {
        width: _tried(q, WIDTHS),
        slow: Parameter(None, lower=0.0, fixed=True, guess=Share(v, SLOW)),
    }
    memory = {z: Dictionary((Term(rate, None, inner),))}
    return Effect(
        "hysteresis", "F", p, _term(f"-{z}", f"hysteresis_force_{p}", lower=0.0), memory
    )


def _actuators(model: Model, p: str) -> list[Effect]:
    """What may be between an input and its force: dF_du is the slope of the model's own
    force in the input.
    """
    used = {
        name for term in model.F.get(p, Dictionary()) for name in names_of(term.body)
    }
    effects: list[Effect] = []
    for u in model.inputs:
        of = "" if len(model.inputs) == 1 else f" of {u}"
        effects.append(
            Effect(
                f"quadratic input{of}",
                "F",
                p,
                _term(f"{u}**2", f"quadratic_input_{u}_{p}"),
            )
        )
        if u not in used:
            effects.append(
                Effect(f"input gain{of}", "F", p, _term(u, f"input_gain_{u}_{p}"))
            )
            continue
        effects += [
            Effect(f"{kind}{of}", "F", p, term, memory)
            for kind, term, memory in _paths(u, p)
        ]
    return effects


def _paths(u: str, p: str) -> Iterator[tuple[str, Dictionary, dict[str, Dictionary]]]:
    gain = f"dF_d{u}"

    def formula(
        body: str,
        name: str,
        of: str,
        shares: tuple[float, ...],
        most: float = ALL,
        unit: str = "",
    ) -> Dictionary:
        return Dictionary((Term(body, None, {name: _tried(of, shares, most, unit)}),))

    dead, limit = f"dead_zone_{u}_{p}", f"saturation_{u}_{p}"
    yield "input gain", _term(f"{gain}*{u}", f"input_gain_{u}_{p}"), {}
    yield (
        "input dead zone",
        formula(f"-{gain}*min(max({u}, -{dead}), {dead})", dead, u, DEAD_ZONES),
        {},
    )
    beyond = f"-{gain}*({u} - min(max({u}, -{limit}), {limit}))"
    yield "input saturation", formula(beyond, limit, u, SATURATIONS), {}
    lag, lagged = f"lag_{u}_{p}", f"{u}_lagged_{p}"
    late = Dictionary((Term(f"{gain}*({lagged} - {u})", None, {}),))
    yield (
        "input lag",
        late,
        {lagged: formula(f"({u} - {lagged})/{lag}", lag, "dt", DELAYS, np.inf, "s")},
    )
    term, memory = _delayed(u, f"delay_{u}_{p}", f"{u}_delayed_{p}", gain)
    yield "input delay", term, memory


def _delayed(
    signal: str, tau: str, state: str, factor: str
) -> tuple[Dictionary, dict[str, Dictionary]]:
    """factor (s(t - tau) - s(t)) by Pade's approximation of order three, with three
    states a, b = a', c = a''.

    c' = 120/tau^3 (s - a) - 60/tau^2 b - 12/tau c and s(t - tau) = s - 2 (s - a) +
    tau^2/5 c; the phase is right to 1 % up to tau times the frequency = 4.
    """
    inner, rate, bend = (
        {tau: _tried("dt", DELAYS, unit="s")},
        f"{state}_rate",
        f"{state}_bend",
    )
    late = f"2*({state} - {signal}) + {tau}**2/5*{bend}"
    force = f"120/{tau}**3*({signal} - {state}) - 60/{tau}**2*{rate} - 12/{tau}*{bend}"
    memory = {
        state: Dictionary((Term(rate, None, {}),)),
        rate: Dictionary((Term(bend, None, {}),)),
        bend: Dictionary((Term(force, None, inner),)),
    }
    return Dictionary(
        (Term(f"{factor}*({late})" if factor else late, None, inner),)
    ), memory


def _sensors(x: str) -> list[Effect]:
    """What a sensor of the state x may add to it."""
    limit = f"clipping_{x}"
    cut = Term(
        f"min(max({x}, -{limit}), {limit}) - {x}", None, {limit: _tried(x, LEVELS, ALL)}
    )
    late, memory = _delayed(x, f"sensor_delay_{x}", f"{x}_delayed", "")
    return [
        Effect("sensor offset", "sensor", x, _term("1", f"sensor_offset_{x}")),
        Effect("sensor gain", "sensor", x, _term(x, f"sensor_gain_{x}")),
        Effect("sensor drift", "sensor", x, _term("t", f"sensor_drift_{x}")),
        Effect("sensor clipping", "sensor", x, Dictionary((cut,))),
        Effect("sensor delay", "sensor", x, late, memory),
    ]


def _is_in(model: Model, effect: Effect) -> bool:
    """Whether the model can do already what the effect does: a term of the same body,
    or the same change of dx/dt.
    """
    terms = (
        model.H
        if effect.slot == "H"
        else getattr(model, effect.slot).get(effect.equation, Dictionary())
    )
    bodies = {term.body for term in terms}
    if any(term.body in bodies for term in effect.term) or set(effect.memory) & set(
        model.states
    ):
        return True
    if any(term.name in model.entries for term in effect.term if term.name):
        return True
    return bool(model.free) and not is_scanned(effect) and _is_spanned(model, effect)


def _is_spanned(model: Model, effect: Effect) -> bool:
    """Whether the slope of dx/dt, and of what is shown, in the effect's coefficient is
    a sum of the model's own slopes.

    Looked at in random states and at random parameter values (fixed seed): an identity
        holds in all of them.
    """
    larger = model.add(effect)
    rng = np.random.default_rng(0)
    # The same values for the whole test: the model's parameters must explain the effect
    # at one point of theta. The effect's coefficient is zero there, so that no
    # parameter acts through it.
    values = {n: model.values.get(n) or rng.uniform(0.5, 1.5) for n in larger.free}
    values |= {
        n: 0.0
        for n in larger.free
        if n not in model.entries and larger.entries[n].prunable
    }
    theta = np.array(list(values.values()))
    n = 4 * len(theta) + 20
    x, u, t = (
        rng.normal(size=(larger.n_states, n)),
        rng.normal(size=(larger.n_inputs, n)),
        rng.uniform(0, 3, (1, n)),
    )
    columns = np.nan_to_num(
        np.array(_slopes(larger).map("slopes", "serial", n, [3], [])(x, u, t, theta))
    )
    columns = columns.reshape(2 * larger.n_states, n, len(theta)).reshape(
        -1, len(theta)
    )
    new = [i for i, name in enumerate(larger.free) if name not in model.entries]
    own = columns[:, [i for i in range(len(theta)) if i not in new]]
    left = columns[:, new] - own @ np.linalg.lstsq(own, columns[:, new], rcond=None)[0]
    return bool(np.linalg.norm(left) < 1e-8 * np.linalg.norm(columns[:, new]))


def _slopes(model: Model) -> ca.Function:
    """CasADi function (x, u, t, theta) -> slopes of dx/dt and of what is shown in
    theta, (2 n_states, n_free).
    """
    rhs, output = model.rhs(), model.output()
    arguments = [ca.SX.sym(rhs.name_in(i), rhs.size1_in(i)) for i in range(rhs.n_in())]
    both = ca.vertcat(rhs(*arguments), output(*arguments))
    return ca.Function(
        "slopes", arguments, [ca.densify(ca.jacobian(both, arguments[3]))]
    )

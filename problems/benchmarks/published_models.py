"""Models with published verdicts on which of their parameters can be identified.

The models and verdicts are those of the tests of StructuralIdentifiability.jl (Dong,
Goodbrake, Harrington and Pogudin, SIAM Journal on Applied Algebra and Geometry 7, 2023;
github.com/SciML/StructuralIdentifiability.jl, ``test/identifiability.jl``,
``local_identifiability.jl``, ``local_identifiability_me.jl`` and
``identifiable_functions.jl``), retyped; where these name the paper of a model, it
stands in the row. A parameter is unidentifiable where no identifiable function and no
locally identifiable parameter of theirs fixes it.
"""

from dataclasses import dataclass

import phsi_opt as ph


@dataclass(frozen=True)
class Published:
    """A model, its sensors, and what is known of it.

    Args:
        name: the model.
        rates: a right-hand side per state.
        sensors: what is measured: a state, or a state and what the sensor adds to it.
        unidentifiable: parameters of which no record tells the value.
        combinations: of them that are identifiable, as we write them.
        inputs: names of the inputs.
        runs: number of records.
    """

    name: str
    rates: dict[str, str]
    sensors: dict[str, str]
    unidentifiable: frozenset[str] = frozenset()
    combinations: frozenset[str] = frozenset()
    inputs: tuple[str, ...] = ()
    runs: int = 1

    def model(self) -> ph.FirstOrder:
        """In our form: measured = state + sensor terms."""
        added = {state: terms for state, terms in self.sensors.items() if terms}
        return ph.FirstOrder(
            list(self.rates), self.rates, inputs=self.inputs, sensor=added
        )


def _names(text: str) -> frozenset[str]:
    return frozenset(filter(None, map(str.strip, text.split(","))))


def _row(
    name: str,
    rates: str,
    sensors: str,
    unidentifiable: str = "",
    combinations: str = "",
    inputs: tuple[str, ...] = (),
    runs: int = 1,
) -> Published:
    """Of lines "state: rate"; sensors "x1, x2: what it adds"."""
    of_states = {}
    for line in filter(None, map(str.strip, rates.splitlines())):
        state, _, rate = line.partition(":")
        of_states[state] = rate.strip()
    of_sensors = {}
    for part in sensors.split(","):
        state, _, added = part.partition(":")
        of_sensors[state.strip()] = added.strip()
    return Published(
        name,
        of_states,
        of_sensors,
        _names(unidentifiable),
        _names(combinations),
        inputs,
        runs,
    )


TWO_COMPARTMENTS = "x0: -(a01 + a21)*x0 + a12*x1\n x1: a21*x0 - a12*x1"
GOODWIN = """
    x1: -b*x1 + 1/(c + x4)
    x2: alpha*x1 - beta*x2
    x3: gama*x2 - delta*x3
    x4: sigma*x4*(gama*x2 - delta*x3)/x3
"""
THREE_COMPARTMENTS = """
    x1: -a1*x1 + b1*x2 {}
    x2: -(a2 + b1)*x2 + a1*x1 + b2*x3
    x3: -b2*x3 + a2*x2 {}
"""
CHAIN_OF_TWO = "x1: -a1*x1 + a21*x2\n x2: -a2*x2 - a21*x2 {}"
AKT = """
    EGFR: turnover*pro + EGF_EGFR*k12 - EGFR*turnover - EGF_EGFR*k11
    pEGFR: EGF_EGFR*k91 - pEGFR*k41 + pEGFR_Akt*k22 + pEGFR_Akt*k31 - Akt*pEGFR*k21
    pEGFR_Akt: Akt*pEGFR*k21 - pEGFR_Akt*k31 - pEGFR_Akt*k22
    Akt: pAkt*k71 + pEGFR_Akt*k22 - Akt*pEGFR*k21
    pAkt: pAkt_S6*k52 - pAkt*k71 + pAkt_S6*k61 + pEGFR_Akt*k31 - S6*pAkt*k51
    S6: pAkt_S6*k52 + pS6*k81 - S6*pAkt*k51
    pAkt_S6: S6*pAkt*k51 - pAkt_S6*k61 - pAkt_S6*k52
    pS6: pAkt_S6*k61 - pS6*k81
    EGF_EGFR: EGF_EGFR*k11 - EGF_EGFR*k91 - EGF_EGFR*k12
"""

PUBLISHED = (
    _row("decay with an input", "x: a*x + u", "x", inputs=("u",)),
    _row("two ramps", "x1: a\n x2: -a", "x1: x2", "a"),
    _row("one shift in two rates", "x1: x2 - a\n x2: x1 + a", "x1: x2", "a"),
    _row(
        "Ljung and Glad 1994, example 2",
        "x1: th*x2**2\n x2: u",
        "x1",
        inputs=("u",),
    ),
    _row(
        "Ljung and Glad 1994, example 4",
        "x: -V*x/(km + x) + k01*x",
        "x: (c - 1)*x",
        "V, km, c",
        "V*c, km*c",
    ),
    _row("gain of a sensor", "x: a*x + b*u", "x: (c - 1)*x", "b, c", "b*c", ("u",)),
    _row(
        "two compartments",
        TWO_COMPARTMENTS,
        "x0",
        "a01, a12, a21",
        "a01*a12, a01 + a12 + a21",
    ),
    _row(
        "Bellman and Astrom 1970, example 2",
        "x1: -(k1 + k2)*x1 + k3*x2 + u\n x2: k2*x1 - (k3 + k4)*x2",
        "x1",
        "k1, k2, k3, k4",
        "k1 + k2, k2*k3, k3 + k4",
        ("u",),
    ),
    _row(
        "three modes",
        "x1: l1*x1 + b1*u1\n x2: l2*x2 + b2*u2\n x3: l3*x3 + b3*u3",
        "x1: x2 + x3",
        inputs=("u1", "u2", "u3"),
    ),
    _row(
        "three compartments, input at the first",
        THREE_COMPARTMENTS.format("+ u", ""),
        "x1",
        inputs=("u",),
    ),
    _row(
        "Bellman and Astrom 1970, example 3",
        THREE_COMPARTMENTS.format("", "+ u"),
        "x1",
        "a1, a2, b1, b2",
        "b1*b2, a1 + b1 + a2 + b2",
        ("u",),
    ),
    _row(
        "Walter and Pronzato 1996, example 3",
        "x1: p1*x1**2 + p2*x1*x2\n x2: p3*x1**2 + p4*x1*x2",
        "x1",
        "p1, p2, p3, p4",
        "p1 + p4",
    ),
    _row("Goodwin oscillator", GOODWIN, "x1", "alpha, gama"),
    _row(
        "forced SIRS",
        """
        s: mu - mu*s - b0*(1 + b1*x1)*i*s + g*r
        i: b0*(1 + b1*x1)*i*s - (nu + mu)*i
        r: nu*i - (mu + g)*r
        x1: -M*x2
        x2: M*x1
        """,
        "i, r",
        "b1",
    ),
    _row(
        "SEIR with quarantine",
        """
        S: -beta*S*I
        E: beta*S*I - v*E
        I: v*E - psi*I - (1 - psi)*gamma*I
        R: gamma*Q + (1 - psi)*gamma*I
        Q: -gamma*Q + psi*I
        """,
        "Q",
    ),
    _row(
        "biohydrogenation",
        """
        x5: k5*x4/(k6 + x4) - k7*x5/(k8 + x6 + x5)
        x7: k9*x6*(k10 - x6)/k10
        x4: -k5*x4/(k6 + x4)
        x6: k7*x5/(k8 + x6 + x5) - k9*x6*(k10 - x6)/k10
        """,
        "x4, x5",
    ),
    _row(
        "SLIQR",
        """
        S: -b*I*S*Ninv - S*Ninv*u
        I: -I*g + s*Q + a*L
        L: b*I*S*Ninv - a*L
        Q: -e*I*g + I*g - s*Q
        """,
        "I: (Ninv - 1)*I",
        inputs=("u",),
    ),
    _row(
        "Lotka and Volterra with an input",
        "x0: a*x0 - b*x0*x1 + u\n x1: c*x1 + d*x0*x1",
        "x0",
        "b",
        inputs=("u",),
    ),
    _row(
        "SIWR",
        """
        S: mu - bi*S*I - bw*S*W - mu*S + a*R
        I: bw*S*W + bi*S*I - (gam + mu)*I
        W: xi*(I - W)
        R: gam*I - (mu + a)*R
        """,
        "I: (k - 1)*I",
    ),
    _row("two in a row", CHAIN_OF_TWO.format(""), "x1", "a2, a21", "a21 + a2"),
    _row("two in a row, driven", CHAIN_OF_TWO.format("+ u"), "x1", inputs=("u",)),
    _row(
        "a circle",
        "x1: (1 + x1**2)/2\n x2: (1 - x1**2)/(1 + x1**2)",
        "x1: 2*x1/(b*(1 + x1**2)) - x1, x2",
    ),
    _row("a hidden constant", "x1: x1 + th*x2\n x2: 0", "x1", "th"),
    _row("three integrators", "x1: al*x2\n x2: x3\n x3: C", "x1", "C, al", "al*C"),
    _row(
        "a spiral",
        "x1: al*(x1 - x2)\n x2: al*(x1 + x2)",
        "x1: (x1**2 + x2**2)/2 - x1",
    ),
    _row(
        "bilinear, two in parallel",
        "x1: -p1*x1 + p2*u\n x2: -p3*x2 + p4*u\n x3: -(p1 + p3)*x3 + (p4*x1 + p2*x2)*u",
        "x3",
        "p2, p4",
        "p2*p4",
        ("u",),
    ),
    _row(
        "Akt pathway",
        AKT,
        "pEGFR: (a1 - 1)*pEGFR + a1*pEGFR_Akt,"
        "pAkt: (a2 - 1)*pAkt + a2*pAkt_S6, pS6: (a3 - 1)*pS6",
        "turnover, pro, k11, k12, k91, k21, k51, a1, a2, a3",
    ),
    _row(
        "Bruno and others 2016",
        """
        beta: -kbeta*beta
        cry: -cry*kcrybeta - cry*kcryOH
        zea: -zea*kzea
        beta10: cry*kcryOH - beta10*kbeta10 + kbeta*beta
        OHbeta10: cry*kcrybeta + zea*kzea - OHbeta10*kOHbeta10
        """,
        "beta, beta10",
        "kcryOH, kcrybeta, kzea, kOHbeta10",
        "kcryOH + kcrybeta",
    ),
    _row(
        "Ovchinnikov and others, example 7.7, one run",
        "x0: 0\n x1: x0*x1 + mu1*x0 + mu2",
        "x1",
        "mu1, mu2",
    ),
    _row(
        "Ovchinnikov and others, example 7.7, two runs",
        "x0: 0\n x1: x0*x1 + mu1*x0 + mu2",
        "x1",
        runs=2,
    ),
)

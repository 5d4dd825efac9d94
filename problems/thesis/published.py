"""What the thesis publishes of the experiments of its Chapter 6, as printed there."""

from problems.thesis.systems import FLOWS, LEVELS

# Coefficients by system and method: Table 6.1 (noisy data).
_HENON_HEILES = {
    "PHSI": {
        "H[q1**2]": 0.509,
        "H[q2**2]": 0.495,
        "H[q1**2*q2]": 1.009,
        "H[q2**3]": -0.338,
        "H[p1**2]": 0.501,
        "H[p2**2]": 0.477,
        "H[q2*p1**2]": 0.124,
    },
    "SSINN": {
        "H[q1**2]": 0.421,
        "H[q2**2]": 0.378,
        "H[q1**2*q2]": 0.569,
        "H[q2**3]": -0.195,
        "H[p1**2]": 0.484,
        "H[p2**2]": 0.443,
        "H[q2]": 0.004,
        "H[q1*q2]": 0.002,
        "H[p2]": -0.006,
        "H[p1*p2]": -0.006,
    },
}
# Table 6.2 (clean data).
_MASS_SPRING = {
    "PHSI": {
        "H[q**2]": 0.473,
        "H[p**2]": 0.484,
        "R_p": 0.3,
        "F_p[sin(omega_t*t)]": 1.984,
        "F_p.omega_t": 0.505,
    }
}
# Table 6.2, of the right-hand side.
BSI_MASS_SPRING = {
    "F_q[p]": 0.991,
    "F_p[q]": -0.98,
    "F_p[p]": -0.278,
    "F_p[sin(omega_t*t)]": 1.999,
    "F_p.omega_t": 0.506,
}
# Table 6.3 (noisy data): energies of the flows and of the levels, damping of the pipes.
_TANK_ENERGIES = (24.94, 24.98, 24.98, 24.95, 24.97, 4.93, 4.96, 4.89, 4.93)
_TANK_DAMPING = (0.031, 0.029, 0.086, 0.051, 0.041)


def _tanks() -> dict[str, float]:
    energies = [f"H[{state}**2]" for state in (*FLOWS, *LEVELS)]
    damping = [f"R_{flow}" for flow in FLOWS]
    return {
        **dict(zip(energies, _TANK_ENERGIES, strict=True)),
        **dict(zip(damping, _TANK_DAMPING, strict=True)),
    }


COEFFICIENTS: dict[str, dict[str, dict[str, float]]] = {
    "henon_heiles": _HENON_HEILES,
    "mass_spring": _MASS_SPRING,
    "tanks": {"PHSI": _tanks()},
}

# What its text says.
SSINN_BEHIND = "an order of magnitude"  # Section 6.1
PRECISION = {"PHSI": "0.1", "SINDy and BSI": "1 or worse"}  # Section 6.2, noisy data
TANK_NOISE = 0.03  # Section 6.4; its code and its figure have 0.005

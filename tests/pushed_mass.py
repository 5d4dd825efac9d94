"""A mass and its measured force, a model that several tests are about."""

import phsi_opt as ph


def pushed_mass(m: float | ph.Parameter) -> ph.PseudoHamiltonian:
    """m d^2q/dt^2 = u."""
    return ph.PseudoHamiltonian(
        states=["q", "p"],
        inputs=["u"],
        S=ph.canonical(1),
        H=ph.formula("p**2/(2*m)", m=m),
        F={"p": ph.formula("u")},
    )

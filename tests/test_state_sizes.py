"""The sizes by which a program's states are scaled."""

import numpy as np

import phsi_opt as ph
from phsi_opt.initialization.scaling import first_point
from phsi_opt.transcription.grid import AlignedData

T = np.linspace(0.0, 4.0, 401)


def test_slopes_without_a_number_leave_the_size_of_a_hidden_state() -> None:
    # A damper without bound where the position is zero: at both ends of the record.
    model = ph.PseudoHamiltonian(
        states=["q", "p"],
        S=ph.canonical(1),
        H=ph.formula("q**2/2 + p**2/(2*m)", m=2.0),
        R={"p": ph.formula("c/q**2", c=ph.Parameter(0.1, lower=0.0))},
    )
    shown = np.column_stack([np.sin(2 * np.pi * T), np.full(len(T), np.nan)])
    shown[[0, -1], 0] = 0.0
    data = ph.Measurements.from_arrays(T, shown, states=["q", "p"])
    grid = AlignedData.of(model, data).grid
    sizes = first_point(model, grid).x_scale.reshape(-1, 2)
    # p is m dq/dt: 2 pi m over the root of two.
    np.testing.assert_allclose(sizes[:, 1], 2.0 * 2 * np.pi / np.sqrt(2), rtol=0.1)

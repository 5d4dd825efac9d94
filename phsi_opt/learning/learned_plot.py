"""Pictures of a learned force over its first variable, or two, and of its samples."""

from typing import TYPE_CHECKING

import numpy as np

from phsi_opt.learning.force_samples import ForceSamples
from phsi_opt.learning.network import Network
from phsi_opt.presentation.axes import BASELINE, FLOOR, MEASURED, MODEL

if TYPE_CHECKING:
    from matplotlib.axes import Axes

N_MAP_POINTS = 60  # points to a side of a drawn map


def draw_curve(ax: "Axes", network: Network, samples: ForceSamples) -> None:
    """A force of one variable, with the missing force, over the range of the data."""
    v = np.linspace(network.seen[0], network.seen[1], num=300)
    missing = samples.without_physics(samples.w) * samples.std
    ax.plot(samples.v, missing, ".", ms=3, color=MEASURED, label="missing force")
    ax.plot(v, network.at(v), "-", color=MODEL, label="learned force")
    ax.axvline(v[0, 0], color=FLOOR, ls=":", label="range of the data")
    ax.axvline(v[-1, 0], color=FLOOR, ls=":")
    ax.legend(frameon=False)


def draw_map(ax: "Axes", network: Network, samples: ForceSamples, name: str) -> None:
    """Over the first two variables, the others at their means, with the data."""
    first, second, *_ = np.linspace(network.seen[0], network.seen[1], N_MAP_POINTS).T
    points = np.tile(network.shift, (N_MAP_POINTS, N_MAP_POINTS, 1))
    points[:, :, 0] = first
    points[:, :, 1] = second[:, None]
    force = network.at(points)[:, :, 0]
    most = float(np.max(np.abs(force)))
    shades = ax.pcolormesh(
        first, second, force, shading="gouraud", cmap="coolwarm", vmin=-most, vmax=most
    )
    ax.figure.colorbar(shades, ax=ax, label=f"learned {name}")
    ax.plot(*samples.v[:, :2].T, ".", ms=2, color=BASELINE, label="data")
    ax.legend(frameon=False)

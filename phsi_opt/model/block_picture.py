"""A diagram of blocks as a picture: nodes are bars, from which blocks go to others.

The bars stand in a row, in the order of the diagram. Blocks to the ground hang below
them, and blocks between them are in lanes above.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from phsi_opt.model.block_kinds import GROUND, Block
from phsi_opt.presentation.charts import axes_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Bars = Mapping[str, tuple[float, float]]  # where the bar of a node begins and ends


def draw_blocks(blocks: Sequence[Block], ax: "Axes | None" = None) -> "Axes":
    """Draw the bars of the nodes and the blocks at them."""
    hanging: dict[str, list[Block]] = {}  # blocks by their only node
    for block in blocks:
        for node in block.nodes:
            hanging.setdefault(node, []).extend([block] * (len(block.nodes) == 1))
    bars = {}
    right = -2.2
    for node, those in hanging.items():
        start = right + 2.2
        right = start + max(1.6 * len(those), 0.8)
        bars[node] = (start, right)
    lanes = _lanes(blocks, list(bars))
    top = 0.9 * max(lanes.values(), default=0)
    ax = axes_of(ax, (0.8 * right + 1.0, 0.8 * top + 2.8))
    ax.set_axis_off()
    ax.set_aspect("equal")
    ax.set_xlim(-0.3, right + 0.3)
    ax.set_ylim(-2.3, top + 0.6)
    for node, ends in bars.items():
        ax.plot(ends, [0, 0], color="black", linewidth=3, solid_capstyle="butt")
        ax.text(ends[0], -0.1, node, va="top", style="italic", fontsize=9)
    for node, those in hanging.items():
        for k, block in enumerate(those):
            x = bars[node][0] + 0.8 + 1.6 * k
            _line(ax, [x, x], [0, -1.9 if GROUND in block.ports else -1])
            _box(ax, block, x, -1.0)
            if GROUND in block.ports:
                _ground(ax, x, -1.9)
    for block, lane in lanes.items():
        _draw_between(ax, block, 0.9 * lane, bars)
    return ax


def _lanes(blocks: Sequence[Block], order: Sequence[str]) -> dict[Block, int]:
    """The lane of each block between bars; in lane 0 it joins neighbours directly."""
    lanes: dict[Block, int] = {}
    taken: dict[int, set[int]] = {}  # gaps between bars, by lanes
    for block in blocks:
        at = sorted(map(order.index, block.nodes))
        if len(at) < 2:
            continue
        gaps = range(at[0], at[-1])
        lane = 0 if len(gaps) == 1 else 1
        while not taken.setdefault(lane, set()).isdisjoint(gaps):
            lane += 1
        taken[lane] |= {*gaps}
        lanes[block] = lane
    return lanes


def _draw_between(ax: "Axes", block: Block, y: float, bars: Bars) -> None:
    first, *_, last = sorted(block.nodes, key=lambda node: bars[node][0])
    # Risers of higher lanes are further inside their bars.
    left = bars[first][1] - 0.15 * y
    right = bars[last][0] + 0.15 * y
    _line(ax, [left, left, right, right], [0, y, y, 0])
    for node in block.nodes:
        if node not in (first, last):
            middle = 0.7 * bars[node][0] + 0.3 * bars[node][1]
            _line(ax, [middle, middle], [0, y])
    # Over the gap behind the first bar, where no riser of others is.
    behind = min(start for start, _ in bars.values() if start > bars[first][0])
    x = (bars[first][1] + behind) / 2
    if GROUND in block.ports:
        _line(ax, [x, x], [y, y - 0.55])
        _ground(ax, x, y - 0.55)
    _box(ax, block, x, y)


def _line(ax: "Axes", x: Sequence[float], y: Sequence[float]) -> None:
    ax.plot(x, y, color="black", linewidth=1, zorder=1)


def _ground(ax: "Axes", x: float, y: float) -> None:
    for k in range(3):
        half = 0.2 - 0.06 * k
        _line(ax, [x - half, x + half], [y - 0.08 * k] * 2)


def _box(ax: "Axes", block: Block, x: float, y: float) -> None:
    of_roles = {"loss": "tab:orange", "joint": "tab:gray", "gyrator": "tab:gray"}
    of_roles |= dict.fromkeys(("across", "through"), "tab:green")
    look = {"boxstyle": "round", "facecolor": "white"}
    look["edgecolor"] = of_roles.get(block.role, "tab:blue")
    kind = block.kind.replace(" ", "\n")
    text = f"{block.name}\n{kind}"
    ax.text(x, y, text, ha="center", va="center", fontsize=8, bbox=look, zorder=2)

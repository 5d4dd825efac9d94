"""A diagram of blocks as a picture: nodes are bars, from which blocks go to others.

The bars stand in a row, in the order of the diagram. Blocks to the ground hang below
them, and blocks between them are in lanes above.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from phsi_opt.model.block_kinds import GROUND, KINDS, Block
from phsi_opt.presentation.charts import axes_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Bars = Mapping[str, tuple[float, float]]  # where the bar of a node begins and ends


def draw_blocks(blocks: Sequence[Block], ax: "Axes | None" = None) -> "Axes":
    """Draw the bars of the nodes and the blocks at them."""
    order = list(dict.fromkeys(node for block in blocks for node in block.nodes))
    hanging = [block for block in blocks if len(block.nodes) == 1]
    n_hanging = [sum(node in one.nodes for one in hanging) for node in order]
    bars = {}
    right = 0.0
    for node, n in zip(order, n_hanging, strict=True):
        bars[node] = (right, right + max(1.6 * n, 0.8))
        right = bars[node][1] + 2.2
    right -= 2.2
    lanes = _lanes(blocks, order)
    top = 0.9 * max(lanes.values(), default=0)
    ax = axes_of(ax, (0.8 * right + 1.0, 0.8 * top + 2.8))
    ax.set_axis_off()
    ax.set_aspect("equal")
    ax.set_xlim(-0.3, right + 0.3)
    ax.set_ylim(-2.3, top + 0.6)
    for node, ends in bars.items():
        ax.plot(ends, [0, 0], color="black", linewidth=3, solid_capstyle="butt")
        ax.text(ends[0], -0.1, node, va="top", style="italic", fontsize=9)
    places = {node: start + 0.8 for node, (start, _) in bars.items()}
    for block in hanging:
        (node,) = block.nodes
        _line(ax, [places[node]] * 2, [0, -1.9 if GROUND in block.ports else -1])
        _box(ax, block, places[node], -1.0)
        if GROUND in block.ports:
            _ground(ax, places[node], -1.9)
        places[node] += 1.6
    for block, lane in lanes.items():
        _draw_between(ax, block, 0.9 * lane, bars)
    return ax


def _lanes(blocks: Sequence[Block], order: Sequence[str]) -> dict[Block, int]:
    """The lane of each block between bars; in lane 0 it joins neighbours directly."""
    lanes: dict[Block, int] = {}
    taken: set[tuple[int, int]] = set()  # gaps between bars, with their lanes
    for block in blocks:
        at = sorted(map(order.index, block.nodes))
        if len(at) < 2:
            continue
        gaps = range(at[0], at[-1])
        lane = 0 if len(gaps) == 1 else 1
        while taken & {(gap, lane) for gap in gaps}:
            lane += 1
        taken |= {(gap, lane) for gap in gaps}
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
    x = (left + right) / 2
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
    look["edgecolor"] = of_roles.get(KINDS[block.kind].role, "tab:blue")
    kind = block.kind.replace(" ", "\n")
    text = f"{block.name}\n{kind}"
    ax.text(x, y, text, ha="center", va="center", fontsize=8, bbox=look, zorder=2)

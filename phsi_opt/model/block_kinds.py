"""Blocks and what they join: the kinds, and reading a diagram from texts.

Each field has a quantity that all ports at a node share (speed, voltage, pressure,
temperature) and one whose sum over the ports is zero (force, current, flow, heat flow).
The ground is where the first one is zero.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from phsi_opt.arguments import require_known
from phsi_opt.data.checks import checked_names
from phsi_opt.errors import ModelError, shown
from phsi_opt.model.expressions import RESERVED_IN_FORMULAS, names_of
from phsi_opt.model.kinds import ELECTRICAL, HYDRAULIC, MECHANICAL, THERMAL

GROUND = "ground"
FIELDS = {
    "translation": MECHANICAL,
    "rotation": MECHANICAL,
    "electrical": ELECTRICAL,
    "hydraulic": HYDRAULIC,
    "thermal": THERMAL,
}


class Kind(NamedTuple):
    """What a block of a kind is.

    ``role``: "storage" (its state is a momentum, charge, volume or heat), "flux" (a
    flux linkage), "spring", "loss", "joint" (a law between the shared quantities a, b,
    c of its ports), "gyrator" (a law between those and the other one of its last port),
    or a source ("across" of the shared quantity, "through" of the other one).
    ``fields``: of its ports. ``law``: with the name of the block for {n}, x for an
    extension and v for a difference. ``state``: what its state is called, behind the
    name of its node or of itself.
    """

    role: str
    fields: tuple[str, ...]
    unit: str
    law: str
    state: str


def _kinds() -> dict[str, Kind]:
    table = """
    mass | storage | translation | kg | | p
    inertia | storage | rotation | kg m^2 | | p
    capacitor | storage | electrical electrical | F | | q
    tank | storage | hydraulic | m^3/Pa | | V
    thermal storage | storage | thermal | J/K | | Q
    coil | flux | electrical electrical | H | | psi
    fluid inertia | flux | hydraulic hydraulic | kg/m^4 | | psi
    spring | spring | translation translation | N/m | {n}*x |
    torsion spring | spring | rotation rotation | N m/rad | {n}*x |
    damper | loss | translation translation | N s/m | {n}*v |
    torsion damper | loss | rotation rotation | N m s/rad | {n}*v |
    resistor | loss | electrical electrical | Ohm | v/{n} |
    pipe | loss | hydraulic hydraulic | Pa s/m^3 | v/{n} |
    thermal resistance | loss | thermal thermal | K/W | v/{n} |
    lever | joint | translation translation | | a - {n}*b |
    gear | joint | rotation rotation | | a - {n}*b |
    rack | joint | rotation translation | m/rad | b - {n}*a |
    motor | joint | electrical electrical rotation | V s/rad | a - b - {n}*c |
    transformer | joint | electrical electrical electrical electrical | |a-b-{n}*(c-d)|
    piston | gyrator | hydraulic hydraulic translation | m^2 | {n} |
    pump | gyrator | hydraulic hydraulic rotation | m^3/rad | {n} |
    velocity | across | translation translation | | |
    speed | across | rotation rotation | | |
    voltage | across | electrical electrical | | |
    pressure | across | hydraulic hydraulic | | |
    temperature | across | thermal thermal | | |
    force | through | translation translation | | |
    torque | through | rotation rotation | | |
    current | through | electrical electrical | | |
    flow | through | hydraulic hydraulic | | |
    heat flow | through | thermal thermal | | |
    """
    found = {}
    for row in table.strip().splitlines():
        name, role, fields, unit, law, state = map(str.strip, row.split("|"))
        found[name] = Kind(role, tuple(fields.split()), unit, law, state)
    return found


KINDS: Mapping[str, Kind] = _kinds()


@dataclass(frozen=True)
class Block:
    """A block of a diagram: its name, its kind, the node at each port and its law."""

    name: str
    kind: str
    ports: tuple[str, ...]
    law: str

    @property
    def role(self) -> str:
        return KINDS[self.kind].role

    @property
    def fields(self) -> tuple[str, ...]:
        return KINDS[self.kind].fields

    @property
    def unit(self) -> str:
        return KINDS[self.kind].unit

    @property
    def state(self) -> str:
        """What its state is called, by its node, or by its name if it has two ports."""
        symbol = KINDS[self.kind].state
        return f"{symbol}_{self.ports[0] if len(self.ports) == 1 else self.name}"

    @property
    def nodes(self) -> tuple[str, ...]:
        """Those of its ports that are not the ground, each once."""
        return tuple(dict.fromkeys(filter(GROUND.__ne__, self.ports)))

    @property
    def has_parameter(self) -> bool:
        """Whether the name of the block is that of a parameter."""
        is_usual = self.law == KINDS[self.kind].law.format(n=self.name)
        return is_usual and self.role not in ("across", "through")

    def __str__(self) -> str:
        return f"{self.kind} {self.name!r}"


def read_blocks(diagram: Mapping[str, str]) -> list[Block]:
    """The blocks of a diagram, each written as "kind: node, node; law".

    Raises:
        ModelError: a name or a kind that there is not, a port that is not connected, or
            a node of two fields.
    """
    checked_names(list(diagram), "blocks", RESERVED_IN_FORMULAS, ModelError)
    blocks = list(map(_read, diagram.keys(), diagram.values()))
    joined: dict[str, list[Block]] = {}
    fields: dict[str, tuple[str, Block]] = {}
    for block in blocks:
        for node, field in zip(block.ports, block.fields, strict=True):
            if node == GROUND:
                continue
            joined.setdefault(node, []).append(block)
            known, first = fields.setdefault(node, (field, block))
            if known != field:
                raise ModelError(
                    f"node {node!r} joins the {known} of {first} with the {field} of "
                    f"{block}; use two nodes, and a motor, rack or piston between them."
                )
    for node, those in joined.items():
        if len(those) == 1:
            raise ModelError(
                f"{those[0]} is not connected at {node!r}, where no other block is; "
                f"join it to another node, or to {GROUND}."
            )
    by_heat = {"thermal" in block.fields: block for block in blocks}
    if len(by_heat) == 2:
        raise ModelError(
            f"{by_heat[True]} is thermal and {by_heat[False]} is not; the H of heat is "
            "no energy in joules, so make a diagram of its own of the thermal blocks."
        )
    return blocks


def _read(name: str, text: str) -> Block:
    kind, _, rest = text.partition(":")
    nodes, has_law, law = rest.partition(";")
    kind = " ".join(kind.split())
    require_known(kind, KINDS, f"block {name!r}: kind {shown(kind)} is unknown")
    known = KINDS[kind]
    ports = tuple(filter(None, map(str.strip, nodes.split(","))))
    checked_names(ports, "nodes", RESERVED_IN_FORMULAS, ModelError)
    n_ports = len(known.fields)
    if len(ports) != n_ports:
        what = "is not connected" if len(ports) < n_ports else "is too much"
        number = min(len(ports), n_ports) + 1
        raise ModelError(
            f"block {name!r}: a {kind} has {n_ports} port(s), and {text!r} joins "
            f"{len(ports)}; port {number} {what}. Write "
            f"{example(kind)!r}, where a node may be {GROUND}."
        )
    if ports == (GROUND,) or (len(ports) > 1 and ports[0] == ports[1]):
        raise ModelError(
            f"block {name!r}: {text!r} joins {ports[-1]!r} with itself, so that it "
            "does nothing; correct one of its nodes."
        )
    block = Block(name, kind, ports, known.law.format(n=name))
    if not has_law:
        if known.law and name in names_of(known.law.format(n=1)):
            raise ModelError(
                f"block {name!r}: {name} is a variable in the law of a {kind}, "
                f"{known.law.format(n='n')!r} of n; rename the block."
            )
        return block
    variable = {"spring": "x", "loss": "v"}.get(known.role, "")
    if variable not in names_of(law):
        expected = f"a formula in {variable}" if variable else "none: it has no law"
        raise ModelError(
            f"block {name!r}: law={shown(law.strip())} is not possible for a {kind}; "
            f"expected {expected}."
        )
    return Block(name, kind, ports, law.strip())


def example(kind: str) -> str:
    """How a block of a kind is written."""
    nodes: Sequence[str] = "abcd"[: len(KINDS[kind].fields)]
    return f"{kind}: {', '.join(nodes)}"

"""The pictures of docs/: of the tutorial, from its file, and of a diagram of blocks.

python -m problems.examples.docs_pictures
"""

from pathlib import Path

import phsi_opt as ph
from problems.examples import demo
from problems.examples.docs_data import FOLDER as DATA
from problems.tools.pictures import plt

FOLDER = Path(__file__).parents[2] / "docs" / "pictures"

DRIVE = {  # as in docs/how_to/blocks.md
    "u": "voltage: supply, ground",
    "R": "resistor: supply, a",
    "L": "coil: a, b",
    "K": "motor: b, ground, motor",
    "J1": "inertia: motor",
    "k": "torsion spring: motor, load",
    "d": "torsion damper: motor, load",
    "J2": "inertia: load",
    "b": "torsion damper: load, ground",
}


def main() -> None:
    """Write the pictures; the base model is fitted to two runs, one is held out."""
    FOLDER.mkdir(exist_ok=True)
    train, held_out = demo.measurements(DATA / "spring.csv").split(0.7)
    study = ph.Study(demo.model(), train, held_out=held_out)
    figure, ax = plt.subplots(figsize=(8.0, 3.8), layout="constrained")
    study.compare().plot(ax)
    figure.savefig(FOLDER / "tutorial_before.png", dpi=100)
    figure, ax = plt.subplots(figsize=(14.4, 3.6), layout="constrained")
    ph.blocks(DRIVE).plot(ax)
    figure.savefig(FOLDER / "drive.png", dpi=80)
    print("wrote tutorial_before.png and drive.png")


if __name__ == "__main__":
    main()

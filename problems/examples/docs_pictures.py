"""The picture of the tutorial in docs/, from the file that it reads.

python -m problems.examples.docs_pictures
"""

from pathlib import Path

import phsi_opt as ph
from problems.examples import demo
from problems.examples.docs_data import FOLDER as DATA
from problems.tools.pictures import plt

FOLDER = Path(__file__).parents[2] / "docs" / "pictures"


def main() -> None:
    """Write the picture of the base model, fitted to two runs; one run is held out."""
    FOLDER.mkdir(exist_ok=True)
    train, held_out = demo.measurements(DATA / "spring.csv").split(0.7)
    study = ph.Study(demo.model(), train, held_out=held_out)
    figure, ax = plt.subplots(figsize=(8.0, 3.8), layout="constrained")
    study.compare().plot(ax)
    figure.savefig(FOLDER / "tutorial_before.png", dpi=100)
    print("wrote tutorial_before.png")


if __name__ == "__main__":
    main()

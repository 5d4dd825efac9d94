"""The picture of the tutorial in docs/, from the file that it reads.

python -m problems.examples.docs_pictures
"""

from pathlib import Path

import phsi_opt as ph
from problems.examples.docs_data import FOLDER as DATA
from problems.tools.pictures import plt

FOLDER = Path(__file__).parents[2] / "docs" / "pictures"
WIDTH = 8.0  # inches
HEIGHT = 3.8


def study_of_the_tutorial() -> ph.Study:
    """Its base model, fitted to two runs of the spring, one run kept."""
    data = ph.Measurements.from_csv(
        DATA / "spring.csv",
        time="t_s",
        trajectory="run",
        states={"q": "position_m", "p": None},
        units={"t": "s", "q": "m", "p": "kg m/s"},
    )
    train, test = data.split(0.7)
    stiffness = ph.Parameter(10.0, lower=0, unit="N/m")
    model = ph.PseudoHamiltonian(
        states=["q", "p"],
        S=ph.canonical(1),
        H=ph.formula("k*q**2/2 + p**2/(2*m)", k=stiffness, m=2.5),
        R=ph.damping("p"),
    )
    return ph.Study(model, train, held_out=test)


def main() -> None:
    """Write the picture of the base model."""
    FOLDER.mkdir(exist_ok=True)
    figure, ax = plt.subplots(figsize=(WIDTH, HEIGHT), layout="constrained")
    study_of_the_tutorial().compare().plot(ax)
    figure.savefig(FOLDER / "tutorial_before.png", dpi=100)
    print("wrote tutorial_before.png")


if __name__ == "__main__":
    main()

"""``phsi-opt demo``: the files of the demonstration, which ship with the package."""

from importlib.resources import files
from pathlib import Path

from phsi_opt.errors import DataError
from phsi_opt.reading import file_bytes

NAMES = ("friction_spring.csv", "study.toml")


def written_demonstration(folder: Path) -> Path:
    """Write table and study file into a folder; the path of the study file.

    Raises:
        DataError: another file is there, or the folder cannot be written.
    """
    shipped = files("phsi_opt.command_line") / "demo_data"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name in NAMES:
            text = (shipped / name).read_bytes()
            place = folder / name
            if place.exists() and file_bytes(place) != text:
                raise DataError(
                    f"{place} is there already and was changed; it stays as it is. "
                    "Give another folder: phsi-opt demo FOLDER."
                )
            place.write_bytes(text)
    except OSError as error:
        raise DataError(f"{folder} cannot be written ({error}).") from None
    return folder / "study.toml"

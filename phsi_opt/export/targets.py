"""Which files a model can be exported as; none of the libraries is loaded for it."""

import shutil
from pathlib import Path

from phsi_opt.errors import DataError, did_you_mean, shown
from phsi_opt.writing import written_path

SUFFIXES = (".fmu", ".c", ".mo", ".m")


def exported_path(path: str | Path) -> Path:
    """The path of a file to be exported, before the work for it begins.

    Raises:
        DataError: its suffix is not known, its folder is not there, or an FMU is asked
            for where there is no C compiler.
    """
    place = written_path(path)
    if place.suffix not in SUFFIXES:
        raise DataError(
            f"{shown(place.name)} cannot be exported: expected a name that ends in "
            ".fmu (FMI 2.0), .c, .mo (Modelica) or .m (MATLAB)."
            f"{did_you_mean(place.suffix, SUFFIXES)}"
        )
    if place.suffix == ".fmu":
        compiler()
    return place


def compiler() -> str:
    """The path of the C compiler.

    Raises:
        DataError: there is none.
    """
    for name in ("cc", "gcc", "clang"):
        found = shutil.which(name)
        if found:
            return found
    raise DataError(
        "an FMU holds a compiled program, and there is no C compiler (cc, gcc or "
        "clang) on this machine; install one, or export the model as .c."
    )

"""The four experiments of thesis Chapter 6 with every method beside the solver: Tables 6.1-6.4 and Figures 6.1-6.8.

Every method gets the same data: those of the thesis where they are present, else newly drawn ones. A page per system,
results/thesis/<system>.md, and its figures beside it.

    python problems/thesis/experiments.py [--quick] [system ...]
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before NumPy is loaded: equal terms for all
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from thesis import methods
from thesis.systems import SYSTEMS, System, thesis_data_present

import phsi_opt as ph


def training_data(system: System, kind: str, quick: bool) -> ph.Measurements:
    """Data of the thesis, or newly drawn; few of them in quick mode."""
    noise = 0.0 if kind == "clean" else None
    if quick:
        return system.data(1, noise, n=400 if system.name == "henon_heiles" else 8)
    if thesis_data_present():
        return system.thesis_data(kind)
    return system.data(1 if kind == "clean" else 2, noise)


def methods_of(system: System, kind: str, quick: bool) -> dict[str, methods.Method]:
    """The methods of one system in the order of the table; the likelihood, which starts from the solver, is apart."""
    found: dict[str, methods.Method] = {"PHSI, solver": methods.solver}
    if kind == "noisy":
        found["PHSI, threshold alone"] = methods.solver_threshold
    found |= {"PHSI, descent": methods.descent, "BSI, solver": methods.bsi_solver, "BSI, descent": methods.bsi_descent}
    found |= {"SINDy, STLSQ": methods.stlsq, "SINDy, SR3": methods.sr3, "LASSO": methods.lasso}
    if system.name == "henon_heiles":
        found["SSINN"] = methods.ssinn
    return found | {"PHNN": partial(methods.phnn, epochs=2) if quick else methods.phnn}


def identified(system: System, data: ph.Measurements, kind: str, quick: bool) -> dict[str, Any]:
    """Result of every method, or the error it raised."""
    if quick:
        fast = replace(system.descent, epochs=2)
        system = replace(system, descent=fast, descent_noisy=fast)
    results: dict[str, Any] = {}
    for label, method in methods_of(system, kind, quick).items():
        try:
            results[label] = method(system, data, kind, 0)
            if label == "PHSI, solver":
                results["PHSI, likelihood"] = methods.likelihood(system, data, results[label])
        except ph.PhsiOptError as error:
            results[label if label not in results else "PHSI, likelihood"] = error
        print(f"... {system.name}, {kind}, {label}", flush=True)
    return results

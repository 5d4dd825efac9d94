"""Experiments beside the package. Each uses one thread, so that times are comparable;
NumPy reads these variables when it is loaded.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

"""The command line; Hydra and OmegaConf live here and nowhere else.

Importing this package sets the number of threads before NumPy or PyTorch are loaded, because they read it
only once. The systems solved here are small and banded: a second BLAS thread gains nothing on an idle machine
and was measured to cost a factor of 200 on a busy one. Variables that are set already are left alone.
"""

import os

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

for _variable in THREAD_VARIABLES:
    os.environ.setdefault(_variable, "1")

import time

BEGAN = time.time()  # before any other module of this package was read: `efficientnerf.backends.numba.runtime`

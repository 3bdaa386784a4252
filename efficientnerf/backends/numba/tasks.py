"""Which work a parallel loop does in which order."""

from efficientnerf.backends.numba.runtime import numba

STRIDE = 64  # at least as many as a machine has cores


@numba.njit(cache=True, inline="always", error_model="numpy")
def interleaved(task, count):
    """A permutation of 0 to `count` - 1: first each STRIDE-th, then each one after these, ...

    numba gives each thread one run of a loop's numbers. Of work whose costly parts lie side by side (rows of an image, layers of a volume) one thread would get
    most.
    """
    each, more = count // STRIDE, count % STRIDE  # `more` rounds have one element more
    if task < more * (each + 1):
        return task % (each + 1) * STRIDE + task // (each + 1)
    rest = task - more * (each + 1)
    return rest % max(each, 1) * STRIDE + more + rest // max(each, 1)

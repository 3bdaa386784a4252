"""The memory of a stage at its peak, and the refusal of one that does not fit.

Memory decides where data lie and in how large pieces they are worked on, and never what is made: a stage that does not fit even so is refused, with the
setting that would make it smaller. So an artifact has the same bytes whatever memory it was made in, and memory is no part of its request.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from pipeline.errors import TooLittleMemory
from pipeline.executors.memory import Limit, available_now, size_text
from pipeline.stage import Job

MIB = 2**20
TERMS_SHOWN = 3
# The process with the libraries that a stage imports, its compiled kernels, and what the C library keeps of what was freed.
IMAGING = 130 * MIB  # numpy, OpenCV and Pillow
RENDERING = 600 * MIB  # torch and numba with these
SURFACES = 200 * MIB  # SciPy, scikit-image and what decimates, besides these
CUDA = 2048 * MIB  # what torch adds on the host for a CUDA device


def libraries(device: str = "cpu") -> int:
    """Bytes of a process that renders or trains, before it has read anything."""
    return RENDERING + (0 if device == "cpu" else CUDA)


@dataclass(frozen=True)
class Need:
    """Bytes by what takes them, as read after "of": {"training pixels": 3600000000, "libraries": 450000000}."""

    terms: Mapping[str, int]

    @property
    def total(self) -> int:
        return sum(self.terms.values())

    def without(self, what: str, count: int) -> "Need":
        """So many bytes less of a term."""
        return Need({**self.terms, what: self.terms[what] - count})

    def text(self) -> str:
        """The total, and the largest terms."""
        largest = sorted(self.terms.items(), key=lambda term: -term[1])[:TERMS_SHOWN]
        return f"about {size_text(self.total)} of memory ({', '.join(f'{what} {size_text(count)}' for what, count in largest)})"


def fits_now(job: Job, need: Need) -> bool:
    """Whether it fits into what the job may take, and now into what other programs leave. For what changes no bytes."""
    if job.memory is None:
        return True
    now = available_now()
    return need.total <= min(job.memory.bytes, job.memory.bytes if now is None else now)


def most_threads(job: Job, threads: int, need: Callable[[int], Need]) -> int:
    """As many of the threads as `fits_now` for what they take; one where there is space for none."""
    return next((fewer for fewer in range(threads, 1, -1) if fits_now(job, need(fewer))), 1)


def refuse_what_does_not_fit(job: Job, need: Need, remedy: str) -> None:
    """Record the need in the manifest; TooLittleMemory where it is more than the job may take. To be called before the work.

    remedy  what to do about it, a sentence: which settings, with their values
    """
    record(job, need)
    refuse_more_than(job.memory, job.stage, need, remedy)
    now = available_now() if job.memory is not None else None
    if now is not None and need.total > now:
        job.warn(f"{job.stage} needs {need.text()}; only {size_text(now)} are free now. Close other programs if it fails.")


def refuse_more_than(limit: Limit | None, what: str, need: Need, remedy: str) -> None:
    """TooLittleMemory where a need is more than the limit; None: no limit is known.

    what    has the need, the beginning of the sentence
    """
    if limit is not None and need.total > limit.bytes:
        text = f"{what}: needs {need.text()}; {size_text(limit.bytes)} may be taken ({limit.whose}). {remedy} Or give more by --memory."
        raise TooLittleMemory(text, need.total)


def record(job: Job, need: Need) -> None:
    """Put a need into the manifest, next to what was measured (`peak_memory`); of several the largest."""
    if need.total < job.facts.get("memory", {}).get("needed", 0):
        return
    limit = None if job.memory is None else job.memory.bytes
    job.record("memory", {"needed": need.total, "terms": dict(need.terms), "limit": limit})

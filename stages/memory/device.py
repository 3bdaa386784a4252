"""The memory of a CUDA device."""

import torch

from pipeline.executors.memory import size_text
from pipeline.stage import Job


def free_on_device(device: str) -> int:
    """Bytes available on a CUDA device: free ones, and those that this process has reserved but not allocated."""
    return torch.cuda.mem_get_info(device)[0] + torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)


def fits_on_device(job: Job, needed: int, what: str, remedy: str) -> bool:
    """Whether so many bytes are available on the job's device, or that is the CPU; a warning where they are not, and the CPU has to do."""
    if job.device == "cpu" or needed <= (free := free_on_device(job.device)):
        return True
    job.warn(f"{what} needs about {size_text(needed)} on the device; {size_text(free)} are free. The CPU does it, which takes longer."
             f" {remedy} to use the device.")  # fmt: skip
    return False

"""The memory of a CUDA device."""

import torch


def free_on_device(device: str) -> int:
    """Bytes available on a CUDA device: free ones, and those that this process has reserved but not allocated."""
    return torch.cuda.mem_get_info(device)[0] + torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)

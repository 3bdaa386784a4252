"""The machine, for the benchmarks' results."""

import os
import platform
from pathlib import Path
from typing import Any

from pipeline.executors.cores import affinity


def processor() -> str:
    """The processor's name, with its family and model: names such as AMD EPYC leave the generation open."""
    try:
        lines = Path("/proc/cpuinfo").read_text().split("\n\n", 1)[0].splitlines()
    except OSError:
        lines = []
    facts = {key.strip(): value.strip() for key, _, value in (line.partition(":") for line in lines)}
    name = facts.get("model name") or platform.processor() or "unknown"
    return f"{name}, family {facts['cpu family']}, model {facts['model']}" if {"cpu family", "model"} <= facts.keys() else name


def busy_seconds() -> float | None:
    """Seconds that the processors have worked since the machine began, for whatever program; None where the system does not say."""
    try:
        user, nice, system, _idle, _wait, interrupts, soft = (int(word) for word in Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:8])
    except (OSError, ValueError):
        return None
    return (user + nice + system + interrupts + soft) / os.sysconf("SC_CLK_TCK")


def hardware(device: str) -> dict[str, Any]:
    """The hardware of a measurement on "cpu" or "cuda"."""
    found: dict[str, Any] = {"processor": processor(), "cores": affinity(), "device": device}
    if device == "cuda":
        import torch  # programs that choose their cores do so before they load it

        found["device"] = torch.cuda.get_device_name()
    return found | {"load": [round(x, 2) for x in os.getloadavg()]}

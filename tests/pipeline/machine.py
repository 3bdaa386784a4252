"""A root folder as a process in a control group sees it."""

from collections.abc import Mapping
from pathlib import Path


def machine(root: Path, cgroup: str, limits: Mapping[str, str], **proc: str) -> Path:
    """With these lines in /proc/self/cgroup, and these files below /sys/fs/cgroup and /proc; of `proc` self_status is self/status."""
    files = {"proc/self/cgroup": cgroup} | {f"sys/fs/cgroup/{name}": text for name, text in limits.items()}
    for name, text in (files | {f"proc/{name.replace('_', '/')}": text for name, text in proc.items()}).items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    return root

"""The true surface of the still life in examples/, as a file a seventh the size of the PLY that Blender wrote."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import trimesh

MESH = Path(__file__).parent / "data" / "still_life_mesh.npz"


def true_mesh(path: Path = MESH) -> trimesh.Trimesh:
    """In the frame of the true cameras; vertices in the order of Blender's, within half a step of 2.9e-5 of them (the table is 1.9 wide)."""
    import trimesh

    with np.load(path, allow_pickle=False) as held:
        quanta, faces = (np.cumsum(held[name], axis=1, dtype=np.uint16).T for name in ("vertices", "faces"))  # (V, 3), (F, 3)
        return trimesh.Trimesh(held["low"] + quanta * held["step"], faces.astype(np.int64), process=False)


def write_mesh(vertices: np.ndarray, faces: np.ndarray, path: Path = MESH) -> None:
    """Write what `true_mesh` reads.

    vertices  (V, 3), at most 2^16 of them: places in steps of a 65,535th of the longest side, each as its difference from the one before, modulo 2^16
    faces     (F, 3) numbers of vertices, likewise
    """
    low = vertices.min(0)
    step = (vertices - low).max() / 65535
    quanta = np.rint((vertices - low) / step).astype(np.int64)
    differences = {name: np.diff(values, axis=0, prepend=0).astype(np.uint16).T.copy() for name, values in (("vertices", quanta), ("faces", faces))}
    np.savez_compressed(path, low=low, step=step, **differences)  # type: ignore[arg-type]

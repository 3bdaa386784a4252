"""Write synthetic scenes as transforms.json data sets with train, val and test splits. numpy alone renders them; the same arguments give the same files.

    python -m benchmarks.scenes FOLDER [--kinds object,court,window,gloss] [--size 200] [--train 60] [--val 10] [--test 20]

Kinds: `benchmarks.scenes.catalogue`. FOLDER/KIND is a source for `enerf run`. The forward-facing kind is an LLFF data set too, because NDC needs near and far:
`enerf run FOLDER/window --as llff`; then every eighth image is a test view.

    python -m benchmarks.scenes FOLDER --drawn 150 --size 128 --train 40 --val 0 --test 0

FOLDER/drawn_000 and so on are scenes that seeds draw (`benchmarks.scenes.drawn`), on all cores.
"""

import argparse
import json
import math
import os
import shutil
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np

from benchmarks.scenes.catalogue import Recipe, cameras, recipes
from benchmarks.scenes.drawn import drawn
from benchmarks.scenes.rendering import image, nearest
from efficientnerf.geometry.cameras import Camera, opengl_from_pose, rays
from stages.io.pictures import opened

SPLITS = ("train", "val", "test")
POINTS = 4000
FARTHEST = 80.0  # of sparse points, world units


def sparse_points(recipe: Recipe, views: list[Camera], seed: int = 0) -> np.ndarray:
    """(N, 3) points on the surfaces that training cameras see, as structure from motion would find."""
    rng = np.random.default_rng(seed)
    found = []
    for camera in views:
        pixels = rng.random((-(-POINTS // len(views)), 2)) * [camera.width, camera.height]
        origins, directions = rays(camera, pixels)
        distance = nearest(recipe.shapes, origins, directions).distance
        hit = distance < FARTHEST
        found.append(origins[hit] + distance[hit, None] * directions[hit])
    return np.concatenate(found)


def llff_rows(recipe: Recipe, views: list[Camera]) -> np.ndarray:
    """(N, 17) as poses_bounds.npy has them: poses with the axes down, right, back; height, width, focal length; near and far depth of what is seen."""
    rows = []
    for camera in sorted(views, key=lambda view: view.name):
        right, down, forward, centre = camera.world_from_camera[:3].T
        y, x = np.mgrid[2 : camera.height : 4, 2 : camera.width : 4] + 0.5
        origins, directions = rays(camera, np.stack([x, y], -1).reshape(-1, 2))
        distance = nearest(recipe.shapes, origins, directions).distance
        depth = (distance * (directions @ forward))[distance < FARTHEST]
        size = np.array([camera.height, camera.width, camera.intrinsics["fx"]])
        rows.append([*np.stack([down, right, -forward, centre, size], 1).ravel(), 0.95 * depth.min(), depth.max()])
    return np.array(rows)


def write_scene(recipe: Recipe, folder: Path, counts: dict[str, int], size: int, supersample: int = 3) -> None:
    """Images, transforms.json and points.ply of one scene, and poses_bounds.npy of a forward-facing one."""
    import cv2
    import trimesh

    (folder / "images").mkdir(parents=True, exist_ok=True)
    views = {split: cameras(recipe, split, counts[split], size) for split in SPLITS}
    every = [camera for split in SPLITS for camera in views[split]]
    for camera in every:
        pixels = image(recipe.shapes, camera, supersample=supersample, alpha=recipe.alpha, light=recipe.sun)
        cv2.imwrite(str(folder / camera.name), cv2.cvtColor(pixels, cv2.COLOR_RGBA2BGRA if recipe.alpha else cv2.COLOR_RGB2BGR))
    if recipe.forward_facing:
        np.save(folder / "poses_bounds.npy", llff_rows(recipe, every))
    points = sparse_points(recipe, views["train"])
    trimesh.PointCloud(points).export(folder / "points.ply")
    first = every[0].intrinsics
    document = {
        "camera_model": "PINHOLE", "w": every[0].width, "h": every[0].height, "fl_x": first["fx"], "fl_y": first["fx"], "cx": first["cx"], "cy": first["cy"],
        "ply_file_path": "points.ply",
        **{f"{split}_filenames": [camera.name for camera in views[split]] for split in SPLITS},
        "frames": [{"file_path": camera.name, "transform_matrix": opengl_from_pose(camera.world_from_camera).tolist()} for camera in every],
    }  # fmt: skip
    (folder / "transforms.json").write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def as_blender(source: Path, folder: Path) -> Path:
    """The data set with a transforms file for each split, as Blender's data sets have them; one that is so already is returned as it is.

    Raises SystemExit for images without alpha and for cameras that this form cannot hold.
    """
    if (source / "transforms_test.json").exists():
        return source
    document = json.loads((source / "transforms.json").read_text(encoding="utf-8"))
    if document["fl_x"] != document["fl_y"] or (document["cx"], document["cy"]) != (document["w"] / 2, document["h"] / 2):
        raise SystemExit(f"{source}: its cameras are not those of a Blender data set: square pixels, centred")
    frames = {frame["file_path"]: frame["transform_matrix"] for frame in document["frames"]}
    folder.mkdir(parents=True, exist_ok=True)
    for split in ("train", "test"):
        angle = 2 * math.atan(document["w"] / 2 / document["fl_x"])
        listed = [{"file_path": f"./{name.removesuffix('.png')}", "transform_matrix": frames[name]} for name in document[f"{split}_filenames"]]
        (folder / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": angle, "frames": listed}), encoding="utf-8")
        for name in document[f"{split}_filenames"]:
            (folder / name).parent.mkdir(exist_ok=True)
            shutil.copyfile(source / name, folder / name)
            with opened(folder / name) as image:
                if "A" not in image.getbands():
                    raise SystemExit(f"{source / name}: no alpha; what is behind it cannot be made white")
    return folder


def write_drawn(folder: Path, seed: int, counts: dict[str, int], size: int) -> None:
    """The scene of a seed, where it is not written yet."""
    if not (folder / "transforms.json").exists():
        write_scene(drawn(seed), folder, counts, size, supersample=2)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--kinds", default=",".join(recipes()))
    parser.add_argument("--size", type=int, default=200, help="width of the images, pixels; three quarters as high")
    for split, count in zip(SPLITS, (60, 10, 20), strict=True):
        parser.add_argument(f"--{split}", type=int, default=count, help=f"{split} views")
    parser.add_argument("--drawn", type=int, metavar="N", help="instead of kinds: the scenes of seeds 0 to N - 1")
    given = parser.parse_args()
    counts = {split: getattr(given, split) for split in SPLITS}
    if given.drawn:
        with ProcessPoolExecutor(os.cpu_count()) as pool:
            written = [pool.submit(write_drawn, given.folder / f"drawn_{seed:03d}", seed, counts, given.size) for seed in range(given.drawn)]
            for scene in written:
                scene.result()
        return
    wanted = given.kinds.split(",")
    for kind in wanted:
        if kind not in recipes():
            parser.error(f"--kinds: found {kind!r}, expected some of {', '.join(recipes())}")
    for kind in wanted:
        write_scene(recipes()[kind], given.folder / kind, counts, given.size)
        print(f"{given.folder / kind}: written", flush=True)


if __name__ == "__main__":
    main()

"""Frames chosen of a video against every n-th: a hand-held clip is rendered from a run's asset, with motion blur where the hand shakes.

    python -m benchmarks.video_frames RUN OUT [--seconds 10] [--fps 12] [--chosen 40] [--longest 400] [--no-cameras] [--assets 1500]

OUT gets clip.mp4, truth.json (pose and true blur of each frame) and result.json: blur and sharpness of both choices, the share of frames whose cameras were
found, and how far the centres are from the true ones. With --assets, an asset is made of each choice in so many steps of training and a fifth of them of
refinement, with the true cameras; its PSNR is that of the same sharp pictures from places between the frames.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.poses import aligned_errors
from benchmarks.stage_runs import cost_of, read_json
from efficientnerf.asset import format
from efficientnerf.asset.rendering import render
from efficientnerf.capture import frame_choice as choice
from efficientnerf.capture.captured_path import captured_cameras
from efficientnerf.geometry.cameras import Camera, opengl_from_pose, project
from pipeline.errors import BadInput
from stages.artifacts import BakeOutputs, PosesOutputs
from stages.figures.plots import to_uint8
from stages.formats.exporters.video import write_mp4
from stages.io import scene
from stages.sfm.reconstruction import find_cameras
from stages.video.frames import Reader, frames_of, look

SHUTTER = 0.02  # seconds
STEP = 1.5  # px between two of the pictures that a blurred frame is the mean of
MOST = 12  # of these
SHAKES = ((0.08, 0.13), (0.22, 0.3), (0.45, 0.5), (0.62, 0.72), (0.86, 0.9))  # shares of the clip in which the hand shakes
SHAKE, SHAKE_HZ = 0.045, 3.5  # radians, a second
STANDS = ((0.32, 0.4), (0.74, 0.8))  # and in which it stands
DENSE = 1500
TEST_VIEWS = 16


def place(time: np.ndarray) -> np.ndarray:
    """How far along its path the camera is at a share of the clip, 0 to 1: it walks, hurries and stands."""
    grid = np.linspace(0, 1, 4001)
    speed = 1.0 + 0.5 * np.sin(2 * np.pi * 3.3 * grid)
    for begin, end in STANDS:
        speed[(grid >= begin) & (grid < end)] = 0.0
    way = np.concatenate([[0.0], np.cumsum(speed[:-1])])
    return np.asarray(np.interp(time, grid, way / way[-1]))


def camera_at(cameras: list[Camera], time: float, seconds: float) -> Camera:
    """At a share of the clip: on the path, turned by the shaking hand."""
    at = float(place(np.array(time))) * (len(cameras) - 2)
    one, other, share = cameras[int(at)], cameras[int(at) + 1], at % 1
    pose = (1 - share) * one.world_from_camera + share * other.world_from_camera
    left, _, right = np.linalg.svd(pose[:3, :3])
    pose[:3, :3] = left @ right
    strength = max((np.sin(np.pi * (time - begin) / (end - begin)) for begin, end in SHAKES if begin < time < end), default=0.0)
    phase = 2 * np.pi * SHAKE_HZ * time * seconds
    x, y = SHAKE * strength * np.sin(phase), SHAKE * strength * np.sin(1.37 * phase + 1)
    turn = np.array([[1, 0, y], [0, 1, -x], [-y, x, 1.0]])
    left, _, right = np.linalg.svd(turn)
    pose[:3, :3] = pose[:3, :3] @ (left @ right)
    return replace(one, world_from_camera=pose)


def rendered(run: Path, frames: int, fps: int, longest: int, truth: list[dict[str, Any]]) -> Iterator[np.ndarray]:
    """The frames; what is known of each goes into `truth`."""
    tree = format.load(BakeOutputs.of_run(run).asset)
    cameras = path_of(run, longest)
    seconds = frames / fps
    middle = np.median([camera.centre + camera.forward * np.linalg.norm(camera.centre) for camera in cameras], axis=0)[None]
    for index in range(frames):
        opens, closes = index / frames, index / frames + SHUTTER / seconds
        ends = [project(camera_at(cameras, time, seconds), middle)[0][0] for time in (opens, (opens + closes) / 2, closes)]
        blur = float(np.linalg.norm(ends[1] - ends[0]) + np.linalg.norm(ends[2] - ends[1]))
        count = int(np.clip(np.ceil(blur / STEP), 1, MOST))
        times = opens + (np.arange(count) + 0.5) / count * (closes - opens)
        pictures = [render(tree, camera_at(cameras, time, seconds), normals=False).colour for time in times]
        truth.append({"blur": blur, "centre": camera_at(cameras, (opens + closes) / 2, seconds).centre.tolist()})
        yield to_uint8(np.mean([np.clip(picture, 0, 1) ** 2.2 for picture in pictures], axis=0) ** (1 / 2.2))


def path_of(run: Path, longest: int) -> list[Camera]:
    return captured_cameras([view.camera for view in scene.load(PosesOutputs.of_run(run).folder).views], DENSE, longest)


def write_data_set(run: Path, frames: dict[int, Path], count: int, seconds: float, longest: int, out: Path) -> Path:
    """A transforms.json with frames of a clip for training, with the cameras of the middle of their exposure, and sharp test views between them.

    frames  by number, of the clip's `count`
    """
    from PIL import Image

    shutil.rmtree(out, ignore_errors=True)
    (out / "images").mkdir(parents=True)
    tree, cameras = format.load(BakeOutputs.of_run(run).asset), path_of(run, longest)
    entries: dict[str, list[tuple[str, Camera]]] = {"train": [], "test": []}
    for number, path in sorted(frames.items()):
        name = f"images/frame_{number:06d}.png"
        shutil.copyfile(path, out / name)
        entries["train"].append((name, camera_at(cameras, number / count + SHUTTER / seconds / 2, seconds)))
    for k in range(TEST_VIEWS):
        camera, name = camera_at(cameras, (k + 0.5) / TEST_VIEWS, seconds), f"images/test_{k:02d}.png"
        Image.fromarray(to_uint8(render(tree, camera, normals=False).colour)).save(out / name)
        entries["test"].append((name, camera))
    lens = cameras[0]
    document = {
        "camera_model": "PINHOLE", "w": lens.width, "h": lens.height,
        "fl_x": lens.params[0], "fl_y": lens.params[0], "cx": lens.params[1], "cy": lens.params[2],
        **{f"{split}_filenames": [name for name, _ in rows] for split, rows in entries.items()},
        "frames": [
            {"file_path": name, "transform_matrix": opengl_from_pose(camera.world_from_camera).tolist()} for rows in entries.values() for name, camera in rows
        ],
    }  # fmt: skip
    (out / "transforms.json").write_text(json.dumps(document, indent=1))
    return out


def psnr_of_asset(source: Path, out: Path, steps: int) -> dict[str, Any]:
    """PSNR and SSIM of the test views of a data set's asset."""
    shutil.rmtree(out, ignore_errors=True)
    command = [sys.executable, "-m", "workflows.cli.main", "run", str(source), "--out", str(out), "--quiet", "--until", "evaluate"]
    command += ["--set", f"train.iterations={steps}", "--set", f"bake.refine_steps={steps // 5}"]
    cost = cost_of([*command, "--set", "evaluate.captured_path_frames=off", "--set", "splats.make=off"])
    asset = read_json(out / "evaluate" / "metrics.json")["asset"]
    return {"psnr": asset["psnr"], "ssim": asset["ssim"], "views": asset["views"], **cost}


def measured(paths: dict[str, Path], numbers: list[int], truth: list[dict[str, Any]], sharpness: list[float], work: Path | None) -> dict[str, Any]:
    """Figures of a choice; with cameras where there is a scratch folder for them."""
    blur = np.array([truth[number]["blur"] for number in numbers])
    result: dict[str, Any] = {"frames": len(numbers), "blur_mean": blur.mean(), "blur_max": blur.max(), "blurred_over_4_px": int((blur > 4).sum())}
    result |= {"sharpness_mean": np.mean([sharpness[number] for number in numbers])}
    if work is None:
        return result
    quiet: dict[str, Any] = {"progress": lambda *values, **facts: None, "safe_point": lambda: None, "warn": print}
    try:
        capture = find_cameras(work, paths, work=work, **quiet)
    except BadInput as error:
        return result | {"registered": 0, "error": str(error)}
    true = np.array([truth[int(Path(photo.camera.name).stem)]["centre"] for photo in capture.photos])
    errors = aligned_errors(np.array([photo.camera.centre for photo in capture.photos]), true)
    result |= {"registered": len(capture.photos), "centres_rms_percent": 100 * float(np.sqrt(np.square(errors).mean()))}
    return result | {"centres_max_percent": 100 * float(errors.max()), "reprojection_error": capture.reprojection_error, "facts": capture.facts}


def every_nth(clip: Path, frames: int, count: int, out: Path) -> dict[str, Path]:
    """Every n-th frame as PNG."""
    from PIL import Image

    from stages.video.reading import opened

    numbers = set(np.linspace(0, frames - 1, count).round().astype(int).tolist())
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    with opened(clip) as video:
        for frame in video.frames():
            if frame.index in numbers:
                Image.fromarray(frame.rgb(4096)).save(out / f"{frame.index:06d}.png")
    return {f"clip.mp4/{path.name}": path for path in sorted(out.iterdir())}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--fps", type=int, default=12)
    parser.add_argument("--chosen", type=int, default=40)
    parser.add_argument("--longest", type=int, default=400)
    parser.add_argument("--no-cameras", action="store_true")
    parser.add_argument("--assets", type=int, metavar="STEPS", help="make an asset of each choice in so many steps")
    arguments = parser.parse_args()
    clip, frames = arguments.out / "clip.mp4", round(arguments.seconds * arguments.fps)
    if not clip.exists():
        arguments.out.mkdir(parents=True, exist_ok=True)
        truth: list[dict[str, Any]] = []
        write_mp4(rendered(arguments.run, frames, arguments.fps, arguments.longest, truth), clip, fps=arguments.fps, crf=20)
        (arguments.out / "truth.json").write_text(json.dumps(truth))
    truth = json.loads((arguments.out / "truth.json").read_text())
    reader = Reader(1, arguments.out / "work", lambda *values: None, lambda: None, print)
    sharpness = look(clip, reader).sharpness
    chosen = frames_of({"clip.mp4": clip}, count=arguments.chosen, max_side=4096, reader=reader)
    verdicts: Any = chosen.record[0]["verdict"]
    ours = [number for number, verdict in enumerate(verdicts) if verdict == choice.CHOSEN]
    plain = every_nth(clip, len(truth), len(ours), arguments.out / "every_nth")
    nth = [int(Path(name).stem) for name in plain]
    result: dict[str, Any] = {"rank_correlation": _rank_correlation([-each["blur"] for each in truth], sharpness)}
    for name, paths, numbers in (("chosen", chosen.paths, ours), ("every_nth", plain, nth)):
        work = None if arguments.no_cameras else arguments.out / f"cameras_{name}"
        result[name] = measured(paths, numbers, truth, sharpness, work)
        if arguments.assets:
            chosen_files = {int(Path(path_name).stem): path for path_name, path in paths.items()}
            folder = write_data_set(arguments.run, chosen_files, frames, frames / arguments.fps, arguments.longest, arguments.out / f"data_{name}")
            result[name]["asset"] = psnr_of_asset(folder, arguments.out / f"run_{name}", arguments.assets)
        (arguments.out / "result.json").write_text(json.dumps(result, indent=1))
    print(json.dumps(result, indent=1))


def _rank_correlation(a: list[float], b: list[float]) -> float:
    from scipy.stats import spearmanr

    return float(spearmanr(a, b)[0])


if __name__ == "__main__":
    main()

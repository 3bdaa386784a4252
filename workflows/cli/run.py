"""`enerf run` and `enerf stage`."""

import contextlib
import time
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import click

from pipeline.errors import PipelineError, UsageError
from pipeline.executors.local import execute_alone
from pipeline.executors.side_by_side import SideBySide
from pipeline.library_output import kept_in, warnings_for_users
from pipeline.run import Run
from pipeline.runner import run_stages
from pipeline.stage import Stage, settings_of
from stages.cores import count_cores
from workflows.cli.device import resolve_device
from workflows.cli.failures import Reported
from workflows.cli.options import device_option, folder_type, memory_option, output_options, set_option, workflow
from workflows.cli.output import conclude
from workflows.cli.progress import display, warning
from workflows.cli.request import Options, Plan, plan_run
from workflows.cli.resolve import check_stage
from workflows.cli.target import open_run
from workflows.precompilation.start import precompiling
from workflows.report.pages import has_pages, write_pages
from workflows.report.summary import graded, in_words, summary

MOST_JOBS = 4  # stages that need nothing of each other: mesh, splats, turntable and points
MIN_SECONDS = 20.0  # seconds of poses, training and baking; a child takes two to five to import what a stage needs
GRADED = 6  # exit code of a run whose result is graded as --fail-on says


@click.command()
@click.argument("sources", nargs=-1, type=folder_type, metavar="[SOURCE]...")
@click.option("--out", "run_folder", required=True, type=folder_type, metavar="RUN", help="Folder of the run.")
@click.option("--as", "format_name", metavar="FORMAT", help="Format of SOURCE, detected by default. See poses.format in 'enerf presets poses'.")
@click.option("--preset", metavar="NAME",
              help="Preset to start from: tiny, preview (default on the CPU), standard (default on CUDA), high; nerf, paper, paper-n1 to -n4.")  # fmt: skip
@set_option
@click.option("--config", type=folder_type, metavar="FILE", help="TOML file with a table of settings per stage.")
@click.option("--until", metavar="STAGE", help="Stop after this stage.")
@click.option("--from", "start", metavar="STAGE", help="Rerun this stage and the later ones, even if they are up to date.")
@device_option
@memory_option
@click.option("--seed", type=int, help="Random seed of all stages.")
@click.option("--budget", metavar="TIME", help="Time for training field, asset and Gaussians, as 90s, 10m or 1h; sets time_budget of train, bake and splats.")
@click.option("--target-mib", type=float, metavar="N", help="Maximum size of the asset in MiB; sets bake.max_mib.")
@click.option("--frames", type=int, metavar="N", help="Maximum number of frames from videos, 150 by default; sets poses.frames.")
@click.option("--mask", "mask_from", metavar="HOW",
              help="Make silhouettes: foreground (the subject, found by a short first training), static (the object turns, not the background) or a chroma key:"
              " green, white or #rrggbb; sets poses.mask_from.")  # fmt: skip
@click.option("--mask-model", metavar="FILE", help="Make silhouettes with this network, an ONNX file as rembg uses them; sets poses.mask_model.")
@click.option("--features-model", nargs=2, metavar="FILE FILE",
              help="Match photographs that get no camera otherwise with these networks, ONNX files of ALIKED and LightGlue; sets poses.features_model and"
              " poses.matcher_model.")  # fmt: skip
@click.option("--lens", metavar="LENS", help="fisheye, or equirectangular (360 degrees); sets poses.lens. Detected from metadata by default.")
@click.option("--marker-size", metavar="LENGTH",
              help="Edge of printed ArUco or AprilTag markers (their black square), as 50mm, 5cm or 2in: gives metres; sets poses.marker_size.")  # fmt: skip
@click.option("--strict", is_flag=True, help="Refuse a source with missing, unreadable or unregistered images.")
@click.option("--allow-outside", is_flag=True, help="Allow a data set to refer to files outside its folder.")
@click.option("--fail-on", type=click.Choice(["poor", "failed"]), help="Exit with code 6 if the result has this grade or worse; all files are still written.")
@click.option("--jobs", type=click.IntRange(1, 64), metavar="N", help="Stages that run at once, if memory admits it; by default one a core, at most 4.")
@click.option("--viewer", type=click.Choice(["splats", "asset", "both", "off"]),
              help="What RUN/viewer.html shows: the Gaussians if there are any (default) or the asset; both: the asset in RUN/viewer_asset.html.")  # fmt: skip
@click.option("--dry-run", is_flag=True, help="Show what would be done and why, and do nothing.")
@output_options
def run(
    sources: tuple[Path, ...], run_folder: Path, until: str | None, start: str | None, fail_on: str | None, jobs: int | None, dry_run: bool, as_json: bool,
    quiet: bool, **options: Any,
) -> int:  # fmt: skip
    """Turn SOURCE into a baked asset, turntable, mesh and points under RUN, or resume RUN.

    SOURCE is a folder of photographs, a video, or the folder of a Blender, nerfstudio, instant-ngp, LLFF or COLMAP data set. Several folders and
    videos of one scene can be given. Without a SOURCE, RUN is resumed with its recorded settings; options change them. Stages that are up to date are
    skipped.

    The result is graded good, usable, poor or failed. The first line and RUN/evaluate/verdict.json show the grade and what to do. The exit code is 0 for
    every grade, unless --fail-on is given.
    """
    options |= {"format": options.pop("format_name"), "until": until, "source": sources[0] if sources else None, "also": sources[1:]}
    plan = plan_run(run_folder, workflow(), Options(**options))
    return _work(plan, as_json=as_json, quiet=quiet, until=until, start=start, dry_run=dry_run, fail_on=fail_on, jobs=jobs)


@click.command()
@click.argument("name", metavar="NAME")
@click.argument("run_folder", metavar="RUN", type=folder_type)
@set_option
@click.option("--force", is_flag=True, help="Run it even if it is up to date.")
@device_option
@memory_option
@click.option("--dry-run", is_flag=True, help="Show whether it would run and why, and do nothing.")
@output_options
def stage(name: str, run_folder: Path, force: bool, dry_run: bool, as_json: bool, quiet: bool, **options: Any) -> None:
    """Run the stage NAME of RUN on the artifacts of earlier stages. Those are not rerun; stale ones are listed."""
    check_stage(name, workflow().settings)
    for text in options["sets"]:
        if text.partition(".")[0].strip() in workflow().settings.keys() - {name}:
            raise UsageError(f"--set {text}: not a setting of {name}, the only stage that runs here. Use: enerf run --out {run_folder} --set {text}")
    open_run(run_folder)  # says so where it is none
    plan = plan_run(run_folder, workflow(), Options(**options))
    _work(plan, as_json=as_json, quiet=quiet, only=name, force=force, dry_run=dry_run)


def _work(plan: Plan, *, as_json: bool, quiet: bool, dry_run: bool, fail_on: str | None = None, jobs: int | None = 1, **selection: Any) -> int:
    """Run a plan, display its progress, and print the summary; returns the exit code."""
    device = resolve_device(plan.run.device or "auto")
    for option in ("until", "start"):  # before a run is created
        check_stage(selection.get(option), workflow().settings, f"--{'from' if option == 'start' else option} ")
    started = time.monotonic()
    run: Run = plan.run
    try:
        with display(as_json=as_json, quiet=quiet) as show, warnings_for_users(lambda text: show(warning(text))):
            for text in plan.warnings:
                show(warning(text))
            with nullcontext(run) if dry_run else plan.written() as run, nullcontext() if dry_run else kept_in(run.path):
                with precompiling(execute_alone, run.settings, plan.memory) as execute, _side_by_side(run, device, jobs) as side_by_side:
                    outcomes = run_stages(
                        run, workflow().stages, device=device, memory=plan.memory, report=show, dry_run=dry_run, execute=execute, side_by_side=side_by_side,
                        **selection,
                    )  # fmt: skip
                if not dry_run and (any(outcome.action == "ran" for outcome in outcomes) or not has_pages(run, workflow().stages)):
                    write_pages(run, workflow().stages)
    except (Exception, KeyboardInterrupt) as error:
        raise Reported(error, summary(run.path, ())) from error
    facts, elapsed = summary(run.path, outcomes), time.monotonic() - started
    found = None if dry_run or fail_on is None else graded(run.path, outcomes)
    code = GRADED if found is not None and found.is_as_bad_as(str(fail_on)) else 0
    words = [] if as_json or dry_run else in_words(run.path, outcomes, elapsed)
    return conclude(*words, as_json=as_json, quiet=quiet or dry_run, code=code, **facts, elapsed=elapsed, device=device)


def _side_by_side(run: Run, device: str, jobs: int | None) -> AbstractContextManager[SideBySide | None]:
    """What runs stages at the same time; on CUDA, or with one core, nothing does."""
    least = 0.0 if jobs is not None else MIN_SECONDS
    jobs = min(MOST_JOBS, count_cores()) if jobs is None else jobs
    if jobs < 2 or device != "cpu":
        return nullcontext()
    settings = settings_of(workflow().stages, run.settings)

    def need(stage: Stage) -> int | None:
        with contextlib.suppress(PipelineError, OSError, ValueError):  # the stage itself says what is wrong
            return workflow().memory(stage.name, run.path, tuple(run.sources.values()), settings, device)
        return None

    return SideBySide(workflow().child, jobs, count_cores(), need, least)

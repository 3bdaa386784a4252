"""`enerf fleet`, and under it `status`, `retry` and `cancel`."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import click
import msgspec

from pipeline.errors import BadInput, UsageError
from pipeline.executors.dask import CLUSTERS
from pipeline.fleet import requests
from pipeline.fleet.state import FleetState, SceneState, read_fleet
from pipeline.locks.lock import holder_of
from pipeline.text import printable
from workflows.cli.device import resolve_device
from workflows.cli.failures import Reported
from workflows.cli.options import common_options, device_option, folder_type, json_option, memory_limit, memory_option, output_options, set_option, workflow
from workflows.cli.output import closing, conclude, listing, write_json
from workflows.cli.progress import duration, size
from workflows.cli.resolve import read_preset, read_toml
from workflows.fleet.checked import Choice, refuse_what_cannot_work, table_of_options
from workflows.fleet.display import BAD_GRADES, display, overview
from workflows.fleet.manifest import read_manifest
from workflows.fleet.pages.index import quality_of
from workflows.fleet.running import Placement, check_fleet_folder, check_known, is_running, run_fleet, scenes_to_retry
from workflows.fleet.sweeps import read_sweeps, swept


class _Fleet(click.Group):
    """A group with a default command: `enerf fleet SCENES ...` is `enerf fleet run SCENES ...`."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        if not args or args[0] not in (*self.commands, *ctx.help_option_names):
            args = ["run", *args]
        return super().parse_args(ctx, args)


@click.group(cls=_Fleet)
def fleet() -> None:
    """Run many scenes with one command. Each becomes a run under FLEET, as 'enerf run' makes it.

    \b
    enerf fleet shoots/ --out fleet            one run per folder in shoots/
    enerf fleet scenes.toml --out fleet        scenes with their own settings
    enerf fleet status fleet

    Repeat the command to run what is missing or stale. 'enerf fleet run --help' lists the options. Write a folder with the name of a command as
    ./status.
    """


def _placement_options(command: Any) -> Any:
    """Those that say where stages run."""
    for option in reversed((
        click.option("--jobs", type=click.IntRange(1, 1024), default=1, metavar="N",
                     help="Number of concurrent CPU stages per worker, which share its cores and memory; each CUDA device runs one more. By default 1."),
        click.option("--scheduler", metavar="ADDRESS", help="Use the workers of this Dask scheduler, such as tcp://host:8786."),
        click.option("--cluster", type=click.Choice(list(CLUSTERS)), help="Start a Dask cluster: local processes, over ssh, or jobs of a batch queue."),
        click.option("--cluster-options", type=folder_type, metavar="FILE", help="TOML file with options of the cluster."),
        device_option,
        memory_option,
    )):  # fmt: skip
        command = option(command)
    return command


@fleet.command(short_help="Run the scenes of a manifest, or resume them.")
@click.argument("scenes", nargs=-1, required=True, metavar="SCENES...")
@click.option("--out", "folder", required=True, type=folder_type, metavar="FLEET", help="Folder of the fleet.")
@click.option("--preset", metavar="NAME", help="Preset for all scenes.")
@set_option
@click.option("--root", "roots", multiple=True, type=folder_type, metavar="FOLDER",
              help="Allow sources in this folder, besides that of the manifest; may be repeated.")  # fmt: skip
@click.option("--seed", type=int, help="Random seed of all stages.")
@click.option("--sweep", "sweeps", multiple=True, metavar="STAGE.NAME=A,B,...", help="Run each scene with each of these values; may be repeated.")
@_placement_options
@output_options
def run(
    scenes: tuple[str, ...], folder: Path, preset: str | None, sets: tuple[str, ...], seed: int | None, sweeps: tuple[str, ...], roots: tuple[Path, ...],
    as_json: bool, quiet: bool, **options: Any,
) -> int:  # fmt: skip
    """Run SCENES under FLEET: a manifest (.toml, .csv), a folder of scenes, a pattern such as 'shoots/*/', or several folders and videos.

    A scene that fails is retried if that may help, otherwise quarantined with the reason; the others continue. The exit code is 0 if all scenes are
    done, otherwise 3.
    """
    check_fleet_folder(folder)
    if preset is not None:
        read_preset(preset, workflow().presets)
    over = Choice(table_of_options(sets, workflow()), preset, seed)
    chosen = swept(read_manifest(scenes, workflow(), folder, over=over, roots=roots), read_sweeps(sweeps, workflow()), workflow().stages)
    refuse_what_cannot_work(chosen, workflow(), folder, scenes[0])
    return _run(folder, chosen, as_json=as_json, quiet=quiet, retry=None, **options)


@fleet.command(short_help="Show the state of each scene.")
@click.argument("folder", metavar="FLEET", type=folder_type)
@json_option
@common_options
def status(folder: Path, as_json: bool) -> None:
    """Show the state of each scene of FLEET, and which process runs it."""
    found, holder = read_fleet(folder), holder_of(folder)
    if as_json:
        write_json({**msgspec.to_builtins(found), "written_by": None if holder is None else holder.text()}, indent=1)
        return
    listing(*_overview(folder, found), *(_line(scene) for scene in found.scenes))
    if holder is not None:
        listing(f"It is being run by {holder.text()}.")
    elif found.state == "running":
        listing("The process that ran it has ended. Give the fleet's command again to go on.")


@fleet.command(short_help="Retry failed and quarantined scenes.")
@click.argument("folder", metavar="FLEET", type=folder_type)
@click.argument("names", nargs=-1, metavar="[SCENE]...")
@_placement_options
@output_options
def retry(folder: Path, names: tuple[str, ...], as_json: bool, quiet: bool, **options: Any) -> int:
    """Retry the failed and quarantined scenes of FLEET, or only the given ones. The process that runs FLEET does it; if there is none, this one."""
    chosen = scenes_to_retry(read_fleet(folder).scenes, names)
    if is_running(folder):
        outcome = requests.outcome(requests.ask(folder, "retry", chosen), lambda: is_running(folder))
        if outcome != "ended":  # else it is for this process to do
            when = "are tried again by the process that runs it" if outcome == "taken" else "will be tried again, once the process that runs it answers"
            closing(f"{folder}: {len(chosen)} scenes {when}")
            return 0
    return _run(folder, None, as_json=as_json, quiet=quiet, retry=chosen, **options)


@fleet.command(short_help="Stop a running fleet, or some of its scenes.")
@click.argument("folder", metavar="FLEET", type=folder_type)
@click.argument("names", nargs=-1, metavar="[SCENE]...")
@common_options
def cancel(folder: Path, names: tuple[str, ...]) -> None:
    """Stop FLEET, or only the given scenes, at the next safe point, on whichever machine it runs. Finished work is kept."""
    check_known(read_fleet(folder).scenes, names)
    if not is_running(folder):
        raise BadInput(f"{folder}: nobody runs it; there is nothing to cancel.")
    outcome = requests.outcome(requests.ask(folder, "cancel", names or None), lambda: is_running(folder))
    what = "all of it" if not names else f"{len(names)} scenes"
    later = "will stop at the next safe point" if outcome == "taken" else "will stop once the process that runs it answers"
    closing(f"{folder}: has ended meanwhile; there is nothing to cancel" if outcome == "ended" else f"{folder}: {what} {later}")


def _placement(jobs: int, scheduler: str | None, cluster: str | None, cluster_options: Path | None, device: str | None, memory: str | None) -> Placement:
    if scheduler is not None and cluster is not None:
        raise UsageError("--scheduler and --cluster: give one. --scheduler uses a Dask cluster that runs, --cluster starts one.")
    if cluster_options is not None and cluster is None:
        raise UsageError(f"--cluster-options {cluster_options}: for which cluster? Give --cluster, too.")
    remote = scheduler is not None or cluster is not None
    if remote and memory is not None:
        raise UsageError("--memory is of this machine; Dask's workers have limits of their own (dask worker --memory-limit).")
    # Other machines may have devices that this one has not.
    resolved = ("cuda" if device == "cuda" else "cpu") if remote else resolve_device(device or "auto")
    given = {} if cluster_options is None else read_toml("--cluster-options", cluster_options)
    return Placement(jobs, scheduler, cluster, given, resolved, memory_limit(memory))


def _run(folder: Path, scenes: Any, *, as_json: bool, quiet: bool, retry: Any, **options: Any) -> int:
    """Run a fleet, display its progress, and print the summary; returns the exit code."""
    placement = _placement(**options)
    try:
        with display(folder, as_json=as_json, quiet=quiet) as show:
            found = run_fleet(folder, scenes, workflow(), placement, retry=retry, report=show, written=show.written)
    except (Exception, KeyboardInterrupt) as error:
        raise Reported(error, {"fleet": str(folder)}) from error
    bad = [each for each in found.scenes if each.state in ("failed", "quarantined") or (each.result is not None and each.result.grade in BAD_GRADES)]
    words = [*_overview(folder, found), *map(_line, bad)]
    return conclude(*words, as_json=as_json, quiet=quiet, code=found.exit_code, fleet=str(folder), totals=asdict(found.totals))


def _overview(folder: Path, found: FleetState) -> list[str]:
    lines = [f"{folder}: {found.state}; {overview(found)}"]
    if found.totals.quarantined:
        lines.append(f"To try again what is quarantined: enerf fleet retry {folder}")
    return lines


def _line(scene: SceneState) -> str:
    psnr = quality_of(scene)["psnr"]
    grade = "" if scene.result is None else f"{printable(scene.result.grade, 10)} result"
    measures = [size(scene.bytes) if scene.bytes else "", f"{psnr:.2f} dB" if psnr is not None else ""]
    parts = [grade, duration(scene.seconds) if scene.seconds else "", *measures]
    return f"{scene.name:<24} {scene.state:<11} {'  '.join(part for part in (*parts, scene.stage or '', scene.reason or '') if part)}".rstrip()

"""`vibrissa sweep`: a study of many whiskers."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vibrissa.cli.terminal import Force, errors, free, output, progress_bars, refuse

if TYPE_CHECKING:
    from vibrissa.sweeps import Study

_SHOW = "show"


def sweep(
    study: Annotated[
        str | None,
        typer.Argument(
            help="The study as TOML (`--example` prints one), or `show` and its results.",
            metavar="STUDY.toml | show",
        ),
    ] = None,
    store: Annotated[
        Path | None, typer.Argument(help="After `show`: the results.", metavar="[STORE]")
    ] = None,
    path: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            help="Where results go, a Zarr folder; with `show`, the folder of the figure.",
            metavar="FOLDER",
        ),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(help="Processes on this machine, 1 by default; 0: none but this one.", min=0),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            help="Of Dask instead: its address, or `local` for a cluster of `--workers` processes.",
            metavar="ADDRESS",
        ),
    ] = None,
    again: Annotated[bool, typer.Option("--again", help="Try again what failed before.")] = False,
    any_version: Annotated[
        bool,
        typer.Option("--any-version", help="Go on though another version of vibrissa began."),
    ] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print number of cells, time and size, and stop.")
    ] = False,
    example: Annotated[
        bool, typer.Option("--example", help="Print a study with all that one can say, and stop.")
    ] = False,
    force: Force = False,
) -> None:
    """Ask the same of many whiskers, here or on a cluster; stopped, it goes on where it was.

    Example: `vibrissa sweep study.toml -o study.zarr`, then `vibrissa sweep show study.zarr`
    """
    try:
        import zarr  # noqa: F401
    except ModuleNotFoundError as missing:
        raise ModuleNotFoundError(
            "studies are kept with zarr: pip install 'vibrissa[sweeps]'"
        ) from missing
    from vibrissa.io.paths import check_readable
    from vibrissa.io.table import read_text
    from vibrissa.sweeps import EXAMPLE, read_study

    if example:
        output.print(EXAMPLE, end="", markup=False, highlight=False, soft_wrap=True)
    elif study is None:
        raise ValueError("a study is needed; `vibrissa sweep --example` prints one")
    elif study == _SHOW:
        options = {"--workers": workers, "--scheduler": scheduler, "--again": again}
        refuse(options | {"--dry-run": dry_run}, "results are only shown")
        _show(store, path, force)
    elif store is not None:
        raise ValueError(f"{store} is one word too many; the store is said with -o")
    elif force:
        raise ValueError("--force is for the figures of `show`; a study goes on with its results")
    else:
        if scheduler not in (None, "local"):
            refuse({"--workers": workers}, f"the workers are those of {scheduler}")
        workers = 1 if workers is None else workers
        text = read_text(check_readable(study))
        try:
            plan = read_study(text, Path(study).parent)
        except ValueError as fault:
            raise ValueError(f"{study}: {fault}") from None
        if dry_run:
            _cost(plan, max(workers, 1))
        else:
            _run(
                plan,
                path or Path(study).with_suffix(".zarr"),
                workers=workers,
                scheduler=scheduler,
                again=again,
                any_version=any_version,
            )


def _run(plan: Study, path: Path, **how: Any) -> None:
    from vibrissa.sweeps import failures, open_sweep, run_sweep, sweep_summary

    try:
        with progress_bars() as tell:
            outcome = run_sweep(
                plan,
                path,
                **how,
                progress=lambda done, total: tell("cells", done, total),
            )
    except KeyboardInterrupt:
        errors.print(
            f"stopped; what is in {path} is whole, and the same command goes on from it",
            highlight=False,
            soft_wrap=True,
        )
        raise typer.Exit(130) from None
    said = f"{outcome.done} cells done, {outcome.failed} of them failed"
    if outcome.skipped:
        said += f"; {outcome.skipped} were there before and skipped"
    if outcome.failed_before:
        said += f", {outcome.failed_before} of which had failed (--again tries them again)"
    if outcome.damaged:
        said += f"; {outcome.damaged} were damaged since they were written, and were done again"
    for fault in outcome.faults:
        errors.print(fault, highlight=False, soft_wrap=True, markup=False)
    output.print(said, highlight=False, soft_wrap=True)
    output.print(sweep_summary(open_sweep(path)), highlight=False, soft_wrap=True, markup=False)
    _print_failures(failures(path))
    output.print(f"results are in {path}", highlight=False, soft_wrap=True)


def _cost(plan: Study, workers: int) -> None:
    output.print(
        f"{plan.size} cells: {len(plan.specimens)} whiskers, "
        f"{', '.join(f'{task} of {plan.count(task)}' for task in plan.tasks)}\n"
        f"about {plan.seconds / 60:.1f} min of one core, {plan.seconds / workers / 60:.1f} min "
        f"with {workers} worker{'s' if workers > 1 else ''} on idle cores\n"
        f"about {max(plan.bytes / 1e6, 1.0):.0f} MB",
        highlight=False,
        soft_wrap=True,
    )


def _show(store: Path | None, folder: Path | None, force: bool) -> None:
    if store is None:
        raise ValueError("say what to show: vibrissa sweep show STORE")
    from vibrissa import plots
    from vibrissa.sweeps import failures, open_sweep, sweep_summary

    found = open_sweep(store).load()
    output.print(sweep_summary(found), highlight=False, soft_wrap=True, markup=False)
    _print_failures(failures(store))
    folder = folder or Path()
    folder.mkdir(parents=True, exist_ok=True)
    names = {task: folder / f"{store.resolve().stem}-{task}" for task in plots.drawable(found)}
    free([name.with_name(f"{name.name}.png") for name in names.values()], force)
    for task, name in names.items():
        figure = plots.sweep_overview(found, task=task)
        for file in plots.save(figure, name, ("png",)):
            output.print(f"wrote {file}", highlight=False, soft_wrap=True)


def _print_failures(faults: dict[str, str], most: int = 3) -> None:
    for cell, text in list(faults.items())[:most]:
        lines = text.strip().splitlines()
        output.print(
            f"failed: {cell.rpartition('-')[0]} of {lines[0]}: {lines[-1]}",
            highlight=False,
            soft_wrap=True,
            markup=False,
        )
    if len(faults) > most:
        output.print(f"and {len(faults) - most} more, in .failures of the store", highlight=False)

"""`vibrissa sweep`: a study of many whiskers."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import typer

import vibrissa as vb
from vibrissa.cli.options import refuse, with_options
from vibrissa.cli.terminal import output, progress_bars, remark, say

_SHOW = "show"
_LISTED = 3  # largest number of failures listed
_BUILT = 1000  # largest number of whiskers that a dry run constructs


@with_options("the results, a Zarr folder; with `show`, a folder for the figures")
def sweep(
    study: str | None = None,
    store: Path | None = None,
    target: Path | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    again: bool = False,
    any_version: bool = False,
    dry_run: bool = False,
    example: bool = False,
    force: bool = False,
) -> None:
    """Run a study of many whiskers on this machine or a cluster; interrupted runs can be continued.

    A whisker that fails does not stop the others; the exit status is then 1.
    Example: `vibrissa sweep study.toml -o study.zarr`, then `vibrissa sweep show study.zarr`
    """
    try:
        import zarr  # noqa: F401
    except ModuleNotFoundError as missing:
        raise ModuleNotFoundError(
            "studies are stored with zarr: pip install 'vibrissa[sweeps]'"
        ) from missing
    if example:
        output.out(vb.sweeps.EXAMPLE, highlight=False, end="")
    elif study is None:
        raise ValueError("a study is needed; `vibrissa sweep --example` prints one")
    elif study == _SHOW:
        options = {"--workers": workers, "--scheduler": scheduler, "--again": again}
        refuse(options | {"--dry-run": dry_run}, "results are only shown")
        _show(store, target or Path(), force)
    elif store is not None:
        raise ValueError(f"{store} is not expected here; state the store by -o")
    elif force:
        raise ValueError("--force is for the figures of `show`; a study continues with its results")
    else:
        if scheduler not in (None, "local"):
            refuse({"--workers": workers}, f"the workers are those of {scheduler}")
        workers = 1 if workers is None else workers
        path = Path(study)
        text = vb.io.read_text(path)
        with vb.io.in_file(path):
            plan = vb.sweeps.read_study(text, path.parent)
        if dry_run:
            _cost(plan, max(workers, 1))
            return
        target = target or path.with_suffix(".zarr")
        how = {"scheduler": scheduler, "again": again, "any_version": any_version}
        _run(plan, target, workers=workers, **how)


def _run(plan: vb.sweeps.Study, path: Path, **how: Any) -> None:
    try:
        with progress_bars() as tell:
            outcome = vb.sweeps.run_sweep(
                plan, path, **how, progress=lambda done, total: tell("cells", done, total)
            )
    except KeyboardInterrupt:
        remark(f"stopped; the results in {path} are complete, and the same command continues")
        raise typer.Exit(130) from None
    except OSError as fault:
        if fault.errno is None or str(path) in str(fault):
            raise
        reason = fault.strerror or str(fault)
        raise OSError(fault.errno, f"{path} cannot be written: {reason}") from fault
    text = f"{outcome.done} cells done, {outcome.failed} of them failed"
    if outcome.skipped:
        text += f"; {outcome.skipped} were there before and skipped"
    if outcome.failed_before:
        text += f", {outcome.failed_before} of which had failed (--again tries them again)"
    if outcome.damaged:
        text += f"; {outcome.damaged} were damaged since they were written, and were done again"
    for line in outcome.faults:
        remark(line)
    say(text)
    say("\n".join(vb.sweeps.sweep_summary(vb.sweeps.open_sweep(path))))
    faults = vb.sweeps.failures(path)
    _print_failures(faults)
    say(f"results are in {path}")
    if faults:
        raise typer.Exit(1)


def _cost(plan: vb.sweeps.Study, workers: int) -> None:
    """Print the size of a study, and construct its whiskers, or a thousand of them."""
    say(
        f"{plan.size} cells: {len(plan.specimens)} whiskers, "
        f"{', '.join(f'{task} of {plan.count(task)}' for task in plan.tasks)}\n"
        f"about {plan.seconds / 60:.1f} min of one core, {plan.seconds / workers / 60:.1f} min "
        f"with {workers} worker{'s' if workers > 1 else ''} on idle cores\n"
        f"about {max(plan.bytes / 1e6, 1.0):.0f} MB"
    )
    if faults := plan.faults(_BUILT):
        _list(f"failed: {name}: {fault}" for name, fault in faults.items())
        raise typer.Exit(1)


def _show(store: Path | None, folder: Path, force: bool) -> None:
    if store is None:
        raise ValueError("state what to show: vibrissa sweep show STORE")
    found = vb.sweeps.open_sweep(store).load()
    say("\n".join(vb.sweeps.sweep_summary(found)))
    _print_failures(vb.sweeps.failures(store))
    folder.mkdir(parents=True, exist_ok=True)
    names = {task: folder / f"{store.resolve().stem}-{task}" for task in vb.plots.drawable(found)}
    for task, name in names.items():
        if (there := name.with_name(f"{name.name}.png")).exists() and not force:
            remark(f"{there} existed before and was not changed; --force replaces it")
            continue
        for file in vb.plots.save(vb.plots.sweep_overview(found, task=task), name, ("png",)):
            say(f"wrote {file}")


def _print_failures(faults: dict[str, str]) -> None:
    each = ((cell, text.strip().splitlines()) for cell, text in faults.items())
    _list(
        (f"failed: {cell.rpartition('-')[0]} of {of[0]}: {of[-1]}" for cell, of in each),
        ", in failures.jsonl of the store",
    )


def _list(failures: Iterable[str], where: str = "") -> None:
    """Print the first failures, and how many more there are."""
    lines = list(failures)
    for line in lines[:_LISTED]:
        say(line)
    if len(lines) > _LISTED:
        say(f"and {len(lines) - _LISTED} more{where}")

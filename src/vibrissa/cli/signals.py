"""`vibrissa signals`: force, moment and signals at a whisker's base from a recording."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

import vibrissa as vb
from vibrissa.cli import inputs
from vibrissa.cli.options import Source, refuse, with_options
from vibrissa.cli.terminal import progress_bars, remark, say, shown
from vibrissa.deferred import xr


@dataclass(frozen=True)
class SourceOptions:
    """Options for the source of the signals."""

    source: Source | None = None
    cutoff: float | None = None
    inertia: bool = False
    density: float | None = None
    damping: float | None = None
    fit_dynamics: bool = False

    def __post_init__(self) -> None:
        about = {"--density": self.density, "--damping": self.damping}
        if self.fit_dynamics:
            refuse(about, "--fit-dynamics determines them")
        if not self.inertia:
            about["--fit-dynamics"] = self.fit_dynamics or None
            refuse(about, "without --inertia the whisker has no mass")

    @classmethod
    def of(cls, tree: xr.DataTree) -> SourceOptions:
        """Options with which existing signals were computed; defaults without signals."""
        about: Any = tree["signals"].attrs if "signals" in tree.children else {}
        source: Any = about.get("source", "").replace(" ", "-") or None
        cutoff = float(about.get("cutoff", 0.0)) if source == "contact-point" else None
        if "density" not in about:
            return cls(source, cutoff)
        density, damping = np.mean(about["density"]), float(about["damping_ratio"])
        usual = np.array_equal(about["density"], vb.simulation.Dynamics().density)
        return cls(source, None, True, None if usual else float(density), damping)

    @property
    def given(self) -> bool:
        """Whether any option is stated."""
        return self.source is not None or self.cutoff is not None or self.inertia

    @property
    def dynamics(self) -> vb.simulation.Dynamics | Literal["fitted"] | None:
        """Density and damping; None to neglect the mass of the whisker."""
        if not self.inertia:
            return None
        if self.fit_dynamics:
            return "fitted"
        usual = vb.simulation.Dynamics()
        return vb.simulation.Dynamics(
            density=usual.density if self.density is None else (self.density, self.density),
            damping_ratio=usual.damping_ratio if self.damping is None else self.damping,
        )

    def as_keywords(
        self, recording: xr.DataTree, own: inputs.WhiskerOptions, proximal: float | None = None
    ) -> dict[str, Any]:
        """Keyword arguments of `signals_of`."""
        source = (
            vb.pipeline.default_source(recording)
            if self.source is None
            else self.source.replace("-", " ")
        )
        if source != "contact point":
            refuse({"--cutoff": self.cutoff}, f"signals of the {source} have a pose of their own")
            whiskers = own.in_recording(recording) if self.inertia else None
            return {"source": source, "whiskers": whiskers, "dynamics": self.dynamics}
        time = recording.to_dataset()["time"].values
        rate = 1.0 / float(np.median(np.diff(time))) if len(time) > 1 else np.inf
        return {
            "source": source,
            "cutoff": inputs.filtered_at(self.cutoff, rate, len(time) / rate),
            "whiskers": own.in_recording(recording),
            "proximal": inputs.smallest_arc(proximal),
            "dynamics": self.dynamics,
        }


@with_options(
    "the recording with the signals added, .nc, by default where it is; or the signals of its "
    "one whisker as a table, .csv"
)
def signals(
    recording: Path,
    how: SourceOptions,
    own: inputs.WhiskerOptions,
    proximal: float | None = None,
    events: Path | None = None,
    target: Path | None = None,
    force: bool = False,
) -> None:
    """Compute force, moment and the six signals at the base in every frame.

    They are added to the recording as the group `signals`. Other groups are kept, except estimates
    and a contour computed from earlier signals.
    Example: `vibrissa signals trial.nc`
    """
    inputs.refuse_tracks(recording)
    target = target or recording
    vb.io.check_writable(target, (*vb.io.NETCDF, *vb.io.CSV))
    if events is not None:
        vb.io.check_writable(events, vb.io.CSV)
    inputs.free_beside(recording, [target, *([] if events is None else [events])], force)
    tree = inputs.recording_from(recording)
    table = target.suffix.lower() in vb.io.CSV
    if table:
        inputs.check_one_whisker(tree, recording)
    with progress_bars() as tell:
        tell("signals", 0, 1)
        keywords = how.as_keywords(tree, own, proximal)
        if keywords["whiskers"] is None:
            unused = {"--whisker": own.whisker, "--proximal": proximal}
            refuse(unused, f"signals of the {keywords['source']} need none")
        with vb.io.in_file(recording):
            done = vb.pipeline.with_signals(tree, **keywords)
        tell("signals", 1, 1)
    inputs.print_notes(*(keywords["whiskers"] or ()))
    remark(described(done))
    found = done["signals"].to_dataset()
    inputs.print_statuses(found["status"].values)
    _print_largest(found)
    if events is not None:
        contacts = vb.pipeline.contact_events(found)
        names = [str(name) for name in contacts]
        columns = (contacts[name].values for name in names)
        vb.io.write_table(events, names, zip(*columns, strict=True))
        inputs.print_written(events)
    if table:
        vb.io.save_signals(target, found.isel(whisker=0)[["force", "moment"]])
    else:
        vb.io.save_recording(target, done)
    inputs.print_written(target, recording, "signals")


def described(tree: xr.DataTree) -> str:
    """Description of the source of the signals of a recording."""
    planar = vb.recording.Recording(tree).planar
    return _origin(tree) + "; one view: depth, Fz, Mx and My are taken as 0" * planar


def _origin(tree: xr.DataTree) -> str:
    about = tree["signals"].attrs if "signals" in tree.children else {}
    source = str(about.get("source", "a source that is not known"))
    if source == "sensor":
        if "density" not in about:
            moved = "with inertia" in str(tree.attrs.get("origin"))
            rings = ", with the whisker's inertia, which --inertia removes" if moved else ""
            return f"signals as the sensor read them{rings}"
        density, damping = (
            " to ".join(f"{value:.4g}" for value in dict.fromkeys(np.ravel(about[name])))
            for name in ("density", "damping_ratio")
        )
        how = ", fitted" if about.get("fitted") else ""
        return (
            f"signals of the sensor minus the whisker's inertia: {density} kg/m³, damping ratio "
            f"{damping}{how}"
        )
    if source == "rod":
        return "signals of the rod that fits the images"
    if source != "contact point":
        return f"signals from {source}"
    cutoff = about.get("cutoff")
    filtered = "not filtered" if cutoff is None else f"filtered at {float(cutoff):g} Hz"
    whiskers = tree["whiskers"].children.values() if "whiskers" in tree.children else ()
    moduli = [float(one.to_dataset(inherit=False)["youngs_modulus"]) / 1e9 for one in whiskers]
    of = f", Young's modulus {moduli[0]:g} GPa" if moduli else ""
    return f"signals from the tracked contact point; the base's pose is {filtered}{of}"


def _print_largest(found: xr.Dataset) -> None:
    """Print the number of frames in contact and the largest force and moment of each whisker."""
    for k, name in enumerate(found["whisker"].values):
        one = found.isel(whisker=k)
        sizes = {n: np.linalg.norm(one[n].values, axis=-1) for n in ("force", "moment")}
        with np.errstate(invalid="ignore"):
            largest = [shown(n, float(np.nanmax(v, initial=0.0)), 3) for n, v in sizes.items()]
        frames = f"{int(one['in_contact'].sum())} of {one.sizes['time']} frames"
        say(f"{name}: in contact in {frames}, up to {largest[0]} and {largest[1]}")

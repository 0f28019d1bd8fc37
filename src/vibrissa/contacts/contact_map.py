"""All stable contacts of a whisker, and the base signals of each.

A :class:`ContactMap` holds the chart of the stable, reachable contacts Ω of one whisker
(:mod:`vibrissa.rod.chart`): contact point, force and moment with exact derivatives at its nodes.
Everything in between is solved exactly when it is asked for; nothing is interpolated. On request it
also holds the paper's grid of contact points: 15 radii from 0.3 L to L, azimuth ±65° and elevation
±60° in steps of 1°.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.contacts.contacts import Contacts
from vibrissa.contacts.engine.prior import Prior
from vibrissa.contacts.engine.ranking import stages_ahead
from vibrissa.contacts.engine.search import estimate
from vibrissa.contacts.fitting.inversion import triplet_tree
from vibrissa.contacts.joint.forward import Gravity
from vibrissa.contacts.joint_estimate import estimate_jointly
from vibrissa.contacts.sensing.channels import determining
from vibrissa.contacts.sensing.noise import common_errors
from vibrissa.contacts.wrench import estimate_components
from vibrissa.deferred import xr
from vibrissa.io import (
    COMPRESSED,
    Kind,
    naming,
    read_dataset,
    read_groups,
    recognise,
    refuse_whisk,
    write_netcdf,
)
from vibrissa.numerics import AnyArray, Array, rotation_matrices
from vibrissa.quantities import attributes
from vibrissa.rod import (
    CELLS,
    PROXIMAL,
    STEPS,
    Discretization,
    Fold,
    PointContact,
    SearchTree,
    StableSet,
    check_whisker,
    compile_seeds,
    contact_tangents,
    deflect,
    discretize,
    resting,
    stable_set,
    with_normal_force,
)
from vibrissa.signals import (
    SIGNALS,
    base_signals,
    concave_backward,
    selection,
    spherical,
    within_cone,
)
from vibrissa.sketch import CONTACT, REST, Mark, card, lines, shown, symbol, views
from vibrissa.status import Status, flag_attributes
from vibrissa.whisker import Whisker

#: The paper's grid: radii over L, azimuth and elevation in rad.
GRID_RADII = np.linspace(0.3, 1.0, 15)
GRID_AZIMUTHS = np.deg2rad(np.arange(-65.0, 66.0))
GRID_ELEVATIONS = np.deg2rad(np.arange(-60.0, 61.0))

_KIND = "vibrissa contact map"
_NODE = ("station", "bearing", "load")

Progress = Callable[[int, int], None]
Domain = Literal["reachable", "paper"]


@dataclass(frozen=True, eq=False)
class ContactMap:
    """Contacts of one whisker and their signals; constructed by :meth:`simulate` or :meth:`load`.

    Attributes
    ----------
    whisker : Whisker
        The whisker.
    chart : StableSet
        The stable contacts, non-dimensional.
    steps : int
        Integration steps along the whisker.
    grid : Dataset or None
        The paper's grid: ``force``, ``moment``, ``arc_length``, the six signals and ``status`` over
        (r, theta, phi).
    """

    whisker: Whisker
    chart: StableSet
    steps: int = STEPS
    grid: xr.Dataset | None = None
    _trees: dict[tuple[str, ...], SearchTree] = field(default_factory=dict, repr=False)
    _determining: dict[tuple[str, ...], bool] = field(default_factory=dict, repr=False)

    @classmethod
    def simulate(
        cls,
        whisker: Whisker,
        *,
        proximal: float = PROXIMAL,
        cells: tuple[int, int, int] = CELLS,
        steps: int = STEPS,
        grid: bool = True,
        progress: Progress | None = None,
    ) -> ContactMap:
        """Chart all stable contacts of a whisker.

        Parameters
        ----------
        whisker : Whisker
            The whisker.
        proximal : float
            Smallest arc length of a contact, as a fraction of the length.
        cells : tuple of int
            Cells of the chart along arc length, bearing and load; each the same power of two times
            a small number. They set how fast estimates are found, not how exact they are.
        steps : int
            Integration steps along the whisker.
        grid : bool
            Whether the paper's grid of 237,765 contact points is solved too (about two seconds).
        progress : callable, optional
            Called as ``progress(done, total)`` while the grid is solved.

        Returns
        -------
        ContactMap
            The map.
        """
        check_whisker(whisker)
        numbers = np.asarray(cells)
        if numbers.shape != (3,) or numbers.dtype.kind != "i" or (numbers < 1).any():
            raise ValueError(f"cells is {cells!r}; three whole numbers from 1 are needed")
        along, around, loads = numbers.tolist()
        rod = discretize(whisker, steps).rod
        compile_seeds(rod, *stages_ahead(rod))
        chart = stable_set(whisker, proximal=proximal, cells=(along, around, loads), steps=steps)
        solved = _solve_grid(whisker, proximal, steps, progress) if grid else None
        return cls(whisker, chart, steps, solved)

    def estimate(
        self,
        signals: xr.Dataset | Mapping[str, ArrayLike],
        using: str | Sequence[str] = ("Fx", "MB", "MD"),
        noise: Mapping[str, float] | ArrayLike | None = None,
        stiffness_sigma: float = 0.0,
        gain_sigma: float | ArrayLike = 0.0,
        mixing_sigma: float | ArrayLike = 0.0,
        compliance_sigma: float = 0.0,
        prior: Prior | None = None,
        friction: float = 0.0,
        gravity: Gravity | ArrayLike | None = None,
        base_rotation: ArrayLike | None = None,
        same_friction: bool = False,
    ) -> Contacts:
        """Find the contacts that explain measured signals.

        Parameters
        ----------
        signals : Dataset or mapping
            Measured signals by name, SI units, any shape, or ``force`` and ``moment``, (..., 3), as
            `vibrissa.load_signals` returns them; for the wrench these, or the six components.
        using : str or sequence of str
            Signals to use, three or more of the six; or "wrench": all six components of force and
            moment, with or without friction, as `estimate_from_wrench` does.
        noise : mapping or (6, 6) array_like, optional
            Standard deviation of each signal, or covariance of (F, M), SI units; gives each
            contact's covariance and probability, and weighs more than three signals.
        stiffness_sigma : float
            Relative standard deviation of the whisker's bending stiffness E r⁴, such as
            ``fit_stiffness`` finds or √(σ_E² + 16 σ_r²) of those of modulus and radius; it adds to
            the covariances, and needs noise.
        gain_sigma : float or (6,) array_like
            Relative standard deviation of the sensor's gains, of all or each of Fx, Fy, Fz, Mx, My
            and Mz; it needs noise.
        mixing_sigma : float or (6, 6) array_like
            Standard deviations of what each of these reads of all six; or one number, relative: of
            the cross-talk among forces, and among moments. It needs noise.
        compliance_sigma : float
            Standard deviation of the compliance of the whisker's base in bending and in twist,
            rad/(N·m): an unknown of each estimate, about the whisker's ``base_stiffness`` or a
            rigid base, that adds to the covariances and is found where more than three signals
            show it. It needs noise.
        prior : Prior, optional
            Possible contacts; others are left out of the candidates.
        friction : float
            Standard deviation of the ratio µ_x of the force along the whisker to that across it,
            which is 0 in the mean, such as 0.3 where coefficients of friction are up to 0.5; 0, the
            default, for contacts without friction. It needs noise. With F_T among four or more
            signals, µ_x is found with the contact; with three the covariance contains what it
            leaves open. The wrench needs none.
        gravity : Gravity or (3,) array_like, optional
            Gravity minus the acceleration of the base, whisker frame, m/s², for a whisker of known
            density that bends under its weight, by a sensor that was tared at rest; or, with the
            tare and what is uncertain, a `Gravity`. Contacts are proposed by a second map, of the
            sagged whisker, made on first use.
        base_rotation : (..., 3, 3) array_like, optional
            Rotation of the base for each measurement or all, from whisker's to laboratory frame:
            gravity and tare are then those of the laboratory and of the first pose.
        same_friction : bool
            Whether friction is absent from all measurements or from none, as when they are of one
            object (with gravity: of those in one pose). By default each decides for itself, with
            four signals or more, and weak friction is missed in most.

        Returns
        -------
        Contacts
            One contact for each measurement, with all candidates.
        """
        using = using if isinstance(using, str) else selection(using)
        errors = common_errors(stiffness_sigma, gain_sigma, mixing_sigma)
        weight = Gravity.of(gravity)
        if base_rotation is not None and gravity is None:
            raise ValueError("base_rotation is given without gravity, which it rotates")
        if weight is None and (using == "wrench" or friction == 0.0):
            plain = (signals, noise, errors, prior, compliance_sigma)
            if using == "wrench":
                return estimate_components(self.whisker, *plain)
            return estimate(self, signals, using, *plain[1:])
        return estimate_jointly(
            self.whisker,
            self,
            signals,
            using,
            noise,
            errors,
            prior,
            gravity=weight,
            friction=0.0 if using == "wrench" else friction,
            compliance_sigma=compliance_sigma,
            stiffness_sigma=stiffness_sigma,
            same_friction=same_friction,
            rotation=None
            if base_rotation is None
            else rotation_matrices("base_rotation", base_rotation),
        )

    def tree(self, triplet: tuple[str, ...]) -> SearchTree:
        """Return the search tree of three signals, made on first use.

        Parameters
        ----------
        triplet : tuple of str
            Three signals, in canonical order.

        Returns
        -------
        SearchTree
            The tree.
        """
        if triplet not in self._trees:
            self._trees[triplet] = triplet_tree(self.chart, selection(triplet))
        return self._trees[triplet]

    def determines(self, using: str | tuple[str, ...]) -> bool:
        """Check whether signals determine contacts on this whisker, but for single ones.

        Parameters
        ----------
        using : str or tuple of str
            Three signals or more.

        Returns
        -------
        bool
            False if almost everywhere the contact can move without changing them, as on a straight
            whisker, which never twists, for any three with Mx. Found out on first use.
        """
        names = selection(using)
        if names not in self._determining:
            self._determining[names] = determining(self, names)
        return self._determining[names]

    @lru_cache(maxsize=8)  # noqa: B019
    def sagged(self, gravity: tuple[float, float, float]) -> ContactMap:
        """Map of a weightless whisker with the shape of this one under its weight."""
        along, around, loads = (n - 1 for n in self.chart.values.shape[:3])
        return ContactMap.simulate(
            resting(self.whisker, gravity).shape(),
            proximal=self.chart.proximal,
            cells=(along, around, loads),
            steps=self.steps,
            grid=False,
        )

    @cached_property
    def _samples(self) -> xr.Dataset:
        whisker, chart, d = self.whisker, self.chart, self.chart.discretization
        force = chart.values[..., :3] * d.force
        point = chart.values[..., 3:] * d.length
        moment = np.cross(point, force)
        # Unknowns are s in L and f in EI/L²; in SI: m and N.
        per_unknown = np.array([d.length, d.force, d.force])
        space = (*_NODE, "space")
        ball = spherical(point)
        xi = with_normal_force(chart.contacts.reshape(-1, 3))
        tangent = contact_tangents(d, xi).reshape(point.shape)
        back = _label("tangent at contact points back")
        data: dict[str, Any] = {
            "arc_length": (_NODE, chart.contacts[..., 0] * d.length, attributes("arc_length")),
            "contact_point": (space, point, attributes("contact_point_whisker")),
            "force": (space, force, attributes("force")),
            "moment": (space, moment, attributes("moment")),
            "contact_point_derivative": (
                (*space, "unknown"),
                chart.tangents[..., 3:, :] * d.length / per_unknown,
                _label("derivative of the contact point by (s, f_y, f_z)", "m / (m, N, N)"),
            ),
            "force_derivative": (
                (*space, "unknown"),
                chart.tangents[..., :3, :] * d.force / per_unknown,
                _label("derivative of the base force by (s, f_y, f_z)", "N / (m, N, N)"),
            ),
            "fold_force": (
                ("station", "bearing"),
                np.exp(chart.fold.log_force[..., 0]) * d.force,
                _label("force at which the whisker slips off", "N"),
            ),
            "small_deflection": (_NODE, within_cone(whisker, point), _label("within 2° of rest")),
            "concave_backward": (_NODE, concave_backward(whisker, point), _label("CB, not CF")),
            "large_deflection": (_NODE, tangent[..., 0] < 0.0, back),
            "status": (
                _NODE,
                np.full(point.shape[:3], int(Status.OK)),
                {**attributes("status"), **flag_attributes()},
            ),
        }
        for i, name in enumerate(("r", "theta", "phi")):
            data[name] = (_NODE, ball[..., i], attributes(name))
        coords = {**node_coordinates(chart), "space": ["x", "y", "z"], "unknown": ["s", "fy", "fz"]}
        out = xr.Dataset(data, coords=coords)
        return out.merge(base_signals(out.force, out.moment))

    def to_dataset(self, domain: Domain = "reachable") -> xr.Dataset:
        """Return the contacts at the chart's nodes as a labelled dataset in SI units.

        Parameters
        ----------
        domain : {"reachable", "paper"}
            All of Ω, or only the contacts within the bounds of the paper's grid, the others NaN.

        Returns
        -------
        Dataset
            Over ``station`` (arc length over L), ``bearing`` (of the force, rad) and ``load``
            (square root of the force over the fold force): contact point, its spherical form, arc
            length, force, moment, signals, derivatives of contact point and force with respect to
            (arc length, f_y, f_z), regions and status.
        """
        if domain not in ("reachable", "paper"):
            raise ValueError(f"domain is 'reachable' or 'paper'; got {domain!r}")
        data = self._samples
        if domain == "paper":
            inside = within_paper_bounds(self.whisker, data.contact_point.to_numpy())
            kept = xr.DataArray(inside, dims=_NODE)
            floats = [name for name, v in data.data_vars.items() if v.dtype.kind == "f"]
            floats = [name for name in floats if "load" in data[name].dims]
            data = data.assign({name: data[name].where(kept) for name in floats})
        return data.copy()

    def save(self, path: str | Path) -> None:
        """Write the map as NetCDF, without loss.

        Parameters
        ----------
        path : str or Path
            The file, ``.nc``; replaced if it exists.
        """
        chart = self.chart
        raw = xr.Dataset(
            {
                "stations": ("station", chart.stations),
                "bearings": ("bearing", chart.bearings),
                "loads": ("load", chart.loads),
                "bounds": ("bound", chart.fold.bounds),
                "fold": (("station", "bearing", "derivative"), chart.fold.log_force),
                "folded": (("station", "bearing"), chart.folded),
                "contacts": ((*_NODE, "unknown"), chart.contacts),
                "values": ((*_NODE, "value"), chart.values),
                "tangents": ((*_NODE, "value", "unknown"), chart.tangents),
                "frames": ((*_NODE, "unknown", "coordinate"), chart.frames),
            },
            attrs={"description": "non-dimensional: lengths over L, forces over EI/L²"},
        )
        for name, variable in raw.data_vars.items():
            variable.attrs |= {"units": "1", "long_name": f"chart: {name}, non-dimensional"}
        root = self.to_dataset()
        root.attrs |= {"kind": _KIND, "steps": self.steps}
        groups = {"/": root, "whisker": self.whisker.to_dataset(), "chart": raw}
        if self.grid is not None:
            groups["grid"] = self.grid
        tree = xr.DataTree.from_dict(groups)
        grid = [] if self.grid is None else list(map(str, self.grid.data_vars))
        write_netcdf(Path(path), tree, {"/grid": dict.fromkeys(grid, COMPRESSED)})

    @classmethod
    def load(cls, path: str | Path, grid: bool = True) -> ContactMap:
        """Read a map written by :meth:`save`.

        Parameters
        ----------
        path : str or Path
            The file.
        grid : bool
            Whether the paper's grid is read, if there is one; estimates do without.

        Returns
        -------
        ContactMap
            The same map.
        """
        path = Path(path)
        refuse_whisk(path)
        what = recognise(path)
        if what not in (Kind.NETCDF, Kind.UNKNOWN):
            raise ValueError(
                f"{path} is not a contact map, as `vibrissa map` writes it; it contains: {what}"
            )
        groups = read_groups(path, ("/", "whisker", "chart", "grid"), {"grid"})
        kind = groups["/"].attrs.get("kind", "")
        if kind != _KIND:
            raise ValueError(f"{path} holds {kind or 'data of another kind'}, not a contact map")
        if missing := [name for name in ("whisker", "chart") if name not in groups]:
            raise ValueError(f"{path} lacks the group {' and '.join(missing)} of a contact map")
        solved = read_dataset(path, "grid") if grid and "grid" in groups else None
        with naming(path, "a contact map"):
            whisker = Whisker.from_dataset(groups["whisker"])
            steps = int(groups["/"].attrs["steps"])
            chart = _chart(groups["chart"].variables, discretize(whisker, steps))
            if solved is not None:  # files store a coordinate of the root only there
                solved = solved.assign_coords(space=["x", "y", "z"])
        return cls(whisker, chart, steps, solved)

    def __repr__(self) -> str:
        nodes = " × ".join(str(n) for n in self.chart.values.shape[:3])
        grid = "" if self.grid is None else f", paper's grid of {self.grid.status.size} points"
        return f"<ContactMap of {self.whisker!r}: {nodes} nodes{grid}>"

    def _repr_html_(self) -> str:
        """Show the contact points that the whisker can hold, with the range of each signal."""
        return card("ContactMap", self._rows(), self.plot())

    def plot(self) -> str:
        """Draw the contact points that the whisker can hold.

        Returns
        -------
        str
            SVG element: the x-y and the x-z plane of the whisker's frame.
        """
        points = self._samples.contact_point.transpose(..., "space").to_numpy()
        return views(
            [
                Mark(points, CONTACT, dots=True, width=1.5, label="contacts"),
                Mark(self.whisker.centerline(41), REST, width=2.5, label="at rest"),
            ]
        )

    def __str__(self) -> str:
        return lines("ContactMap", self._rows())

    def _rows(self) -> list[tuple[str, str]]:
        """Number of contacts, their whisker, and the ranges of the signals."""
        data = self._samples
        rows = [("whisker", repr(self.whisker))]
        rows += [("note", note) for note in self.whisker.notes]
        rows.append(("contacts at nodes", str(data.status.size)))
        if self.grid is not None:
            reached = int((self.grid.status == Status.OK).sum())
            rows.append(("paper's grid", f"{reached} of {self.grid.status.size} points reached"))
        rows.append(("signals", "median (least to largest)"))
        return rows + [(symbol(name), shown(name, data[name])) for name in (*SIGNALS, "r")]


def within_paper_bounds(whisker: Whisker, points: Array) -> AnyArray:
    """Whether contact points are within the bounds of the paper's grid."""
    r, theta, phi = np.moveaxis(spherical(points), -1, 0)
    inside = (r >= 0.3 * whisker.length) & (r <= whisker.length)
    inside &= np.abs(theta) <= GRID_AZIMUTHS[-1]
    return np.asarray(inside & (np.abs(phi) <= GRID_ELEVATIONS[-1]))


def _solve_grid(
    whisker: Whisker, proximal: float, steps: int, progress: Progress | None
) -> xr.Dataset:
    shape = (GRID_RADII.size, GRID_AZIMUTHS.size, GRID_ELEVATIONS.size)
    force, moment = np.empty((*shape, 3)), np.empty((*shape, 3))
    arc_length, status = np.empty(shape), np.empty(shape, np.int64)
    theta, phi = np.meshgrid(GRID_AZIMUTHS, GRID_ELEVATIONS, indexing="ij")
    direction = np.stack(
        [np.cos(phi) * np.cos(theta), np.cos(phi) * np.sin(theta), np.sin(phi)], axis=-1
    )
    for i, r in enumerate(GRID_RADII * whisker.length):
        bent = deflect(whisker, PointContact(r * direction), proximal=proximal, steps=steps)
        force[i], moment[i] = bent.force, bent.moment
        arc_length[i], status[i] = bent.arc_length, bent.status
        if progress is not None:
            progress(i + 1, GRID_RADII.size)
    return grid_dataset(whisker, force, moment, arc_length, status)


def grid_dataset(
    whisker: Whisker, force: Array, moment: Array, arc_length: Array, status: AnyArray
) -> xr.Dataset:
    """Label the paper's grid."""
    dims = ("r", "theta", "phi")
    data = xr.Dataset(
        {
            "force": ((*dims, "space"), force, attributes("force")),
            "moment": ((*dims, "space"), moment, attributes("moment")),
            "arc_length": (dims, arc_length, attributes("arc_length")),
            "status": (dims, status, {**attributes("status"), **flag_attributes()}),
        },
        coords={
            "r": ("r", GRID_RADII * whisker.length, attributes("r")),
            "theta": ("theta", GRID_AZIMUTHS, attributes("theta")),
            "phi": ("phi", GRID_ELEVATIONS, attributes("phi")),
            "space": ["x", "y", "z"],
        },
    )
    return data.merge(base_signals(data.force, data.moment))


def node_coordinates(chart: StableSet) -> dict[Hashable, xr.Variable]:
    """Label the axes along which the nodes of a chart are."""
    angle = _label("force's angle from d1 to d2", "rad")
    return {
        "station": xr.Variable(
            "station", chart.stations, _label("arc length of the contact over L")
        ),
        "bearing": xr.Variable("bearing", chart.bearings, angle),
        "load": xr.Variable("load", chart.loads, _label("square root of force over fold force")),
    }


def _label(long_name: str, units: str = "1") -> dict[str, str]:
    return {"units": units, "long_name": long_name}


def _chart(raw: Mapping[str, AnyArray], discretization: Discretization) -> StableSet:
    """Stable set stored in a file."""
    names = ("stations", "bearings", "loads", "contacts", "values", "tangents", "frames")
    return StableSet(
        discretization=discretization,
        fold=Fold(raw["bounds"], np.ascontiguousarray(raw["fold"])),
        folded=raw["folded"].astype(bool),
        **{name: raw[name] for name in names},
    )

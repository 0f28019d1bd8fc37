"""One table of every physical quantity: its name, symbol, unit and meaning.

The attributes of datasets, the labels of figures and the headings of tables come from here.
Values are in SI units everywhere (``unit``); figures and printed tables show ``value *
display_factor`` in ``display_unit``. F is the force of the object on the whisker and M = p × F
its moment about the base, both in the whisker's frame: base at the origin, x along the tangent at
the base, y toward the side to which the whisker curves. Names and symbols are those of the paper
(Huet, Emnett & Hartmann 2022, doi:10.1371/journal.pcbi.1007763); its mN·mm is our µN·m.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True)
class Quantity:
    """One physical quantity.

    Parameters
    ----------
    name : str
        The name of its variable in datasets and of its column in tables.
    symbol : str
        In mathtext, without the dollar signs.
    unit : str
        SI unit of every stored value; ``"1"`` for a number without one.
    display_unit : str
        Unit in figures and printed tables; empty for a number without one.
    display_factor : float
        What a stored value is multiplied with to be in ``display_unit``.
    long_name : str
        A few words, as in a legend.
    description : str
        What it is exactly: frame, sign, convention.
    """

    name: str
    symbol: str
    unit: str
    display_unit: str
    display_factor: float
    long_name: str
    description: str


@dataclass(frozen=True)
class _Unit:
    """A unit of storage with the unit it is shown in."""

    unit: str
    display: str
    factor: float


_NUMBER = _Unit("1", "", 1.0)
_PERCENT = _Unit("1", "%", 100.0)
_SECOND = _Unit("s", "s", 1.0)
_MM = _Unit("m", "mm", 1e3)
_MICROMETRE = _Unit("m", "µm", 1e6)
_SQUARE_MM = _Unit("m^2", "mm²", 1e6)
_PER_MM = _Unit("1/m", "1/mm", 1e-3)
_DEGREE = _Unit("rad", "°", 180.0 / math.pi)
_MICRONEWTON = _Unit("N", "µN", 1e6)
_MICRONEWTON_METRE = _Unit("N m", "µN·m", 1e6)
_GIGAPASCAL = _Unit("Pa", "GPa", 1e-9)
_STIFFNESS = _Unit("N m^2", "nN·m²", 1e9)
_JOINT_STIFFNESS = _Unit("N m/rad", "µN·m/rad", 1e6)
_SPRING = _Unit("N/m", "N/m", 1.0)
_PARAMETERS = _Unit("(m, 1)^2", "(m, 1)²", 1.0)
_PIXEL = _Unit("pixel", "px", 1.0)
_WRENCH_SQUARED = _Unit("(N, N m)^2", "(N, N·m)²", 1.0)
_POSE_SQUARED = _Unit("(m, rad)^2", "(m, rad)²", 1.0)
_POSE_AND_WRENCH = _Unit("(m, rad)(N, N m)", "(m, rad)(N, N·m)", 1.0)
# The columns of these Jacobians, (s_c, f_y, f_z), differ in unit: it is given column by column.
_POINT_PER_LOAD = _Unit("m/(m, N, N)", "m/(m, N, N)", 1.0)
_FORCE_PER_LOAD = _Unit("N/(m, N, N)", "N/(m, N, N)", 1.0)
_MOMENT_PER_LOAD = _Unit("N m/(m, N, N)", "N·m/(m, N, N)", 1.0)

_ROWS: tuple[tuple[str, str, _Unit, str, str], ...] = (
    # Time and the whisker's shape
    ("time", "t", _SECOND, "time", "Since the start of the recording."),
    ("arc_length", "s", _MM, "arc length", "Along the whisker from its base; of a contact, s_c."),
    ("length", "L", _MM, "whisker length", "Arc length from base to tip."),
    ("radius", "a", _MICROMETRE, "whisker radius", "Of the circular section."),
    (
        "base_radius",
        r"a_\mathrm{base}",
        _MICROMETRE,
        "radius at the base",
        "Of the section at s = 0.",
    ),
    ("tip_radius", r"a_\mathrm{tip}", _MICROMETRE, "radius at the tip", "Of the section at s = L."),
    (
        "curvature",
        r"\kappa",
        _PER_MM,
        "intrinsic curvature",
        "Of the undeflected whisker in its material frame: twist, about d1, about d2.",
    ),
    (
        "centerline",
        r"\mathbf{r}",
        _MM,
        "whisker centreline",
        "Points from base to tip; in the whisker's frame, in a recording in the laboratory frame.",
    ),
    # Material
    ("youngs_modulus", "E", _GIGAPASCAL, "Young's modulus", "Of the whisker's material."),
    ("poisson_ratio", r"\nu", _NUMBER, "Poisson's ratio", "Of the whisker's material."),
    ("bending_stiffness", "EI", _STIFFNESS, "bending stiffness", "E π a⁴ / 4 of a section."),
    ("torsional_stiffness", "GJ", _STIFFNESS, "torsional stiffness", "EI / (1 + ν) of a section."),
    (
        "base_bending_stiffness",
        r"k_\mathrm{B}",
        _JOINT_STIFFNESS,
        "bending stiffness of the base",
        "Of the tissue that holds the whisker; infinite for a rigid clamp.",
    ),
    (
        "base_twist_stiffness",
        r"k_\mathrm{T}",
        _JOINT_STIFFNESS,
        "twist stiffness of the base",
        "Of the tissue that holds the whisker; infinite for a rigid clamp.",
    ),
    # Where the contact is
    (
        "contact_point",
        r"\mathbf{p}",
        _MM,
        "contact point",
        "On the centreline; in the whisker's frame, in a recording in the laboratory frame.",
    ),
    (
        "contact_point_whisker",
        r"\mathbf{p}_\mathrm{w}",
        _MM,
        "contact point in the whisker's frame",
        "On the whisker's centreline.",
    ),
    (
        "x",
        "x",
        _MM,
        "x",
        "Along the tangent at the base, out of the follicle, in the whisker's frame.",
    ),
    ("y", "y", _MM, "y", "Toward the side to which the whisker curves, in the whisker's frame."),
    ("z", "z", _MM, "z", "Normal to x and y, right-handed, in the whisker's frame."),
    ("r", "r", _MM, "radial distance", "Of the contact point from the base, |p|."),
    (
        "theta",
        r"\theta",
        _DEGREE,
        "azimuth",
        "Of the contact point in the whisker's frame, atan2(y, x).",
    ),
    (
        "phi",
        r"\varphi",
        _DEGREE,
        "elevation",
        "Of the contact point in the whisker's frame, asin(z / r).",
    ),
    (
        "deflection_angle",
        r"\delta",
        _DEGREE,
        "deflection angle",
        "Of the contact from the resting whisker: atan of its distance from the nearest point over "
        "the arc length there.",
    ),
    (
        "in_contact",
        r"\mathrm{contact}",
        _NUMBER,
        "whether the whisker touches an object",
        "1 in contact, 0 not.",
    ),
    # The load in the deflected material frame at the contact
    (
        "fx",
        "f_x",
        _MICRONEWTON,
        "contact force along the whisker",
        "Along the deflected tangent at the contact; zero without friction, except at the tip.",
    ),
    ("fy", "f_y", _MICRONEWTON, "contact force along d1", "In the deflected frame at the contact."),
    ("fz", "f_z", _MICRONEWTON, "contact force along d2", "In the deflected frame at the contact."),
    ("magnitude", "f", _MICRONEWTON, "size of the contact force", "hypot(f_y, f_z)."),
    (
        "direction",
        r"\alpha",
        _DEGREE,
        "direction of the contact force",
        "From d1 toward d2 of the deflected frame at the contact.",
    ),
    (
        "contact_force",
        r"\mathbf{f}",
        _MICRONEWTON,
        "contact force",
        "Along the tangent, d1 and d2 of the deflected frame at the contact.",
    ),
    (
        "friction_angle",
        r"\beta",
        _DEGREE,
        "friction angle",
        "Of the force from the plane normal to the whisker, positive toward the tip.",
    ),
    (
        "friction_angle_sigma",
        r"\sigma_\beta",
        _DEGREE,
        "standard deviation of the friction angle",
        "Predicted from the sensor's noise.",
    ),
    # What the base feels
    (
        "force",
        r"\mathbf{F}",
        _MICRONEWTON,
        "force",
        "Of the object on the whisker = of the whisker on the follicle; in the whisker's frame.",
    ),
    (
        "moment",
        r"\mathbf{M}",
        _MICRONEWTON_METRE,
        "moment",
        "About the base, p × F; whisker's frame.",
    ),
    ("Fx", "F_x", _MICRONEWTON, "axial force", "Positive where it pulls the whisker out."),
    ("Fy", "F_y", _MICRONEWTON, "force along y", "In the whisker's frame."),
    ("Fz", "F_z", _MICRONEWTON, "force along z", "In the whisker's frame."),
    ("Mx", "M_x", _MICRONEWTON_METRE, "twisting moment", "About the tangent at the base."),
    ("My", "M_y", _MICRONEWTON_METRE, "moment about y", "About the base, in the whisker's frame."),
    ("Mz", "M_z", _MICRONEWTON_METRE, "moment about z", "About the base, in the whisker's frame."),
    ("FT", "F_T", _MICRONEWTON, "transverse force", "hypot(F_y, F_z)."),
    ("FD", "F_D", _DEGREE, "direction of the transverse force", "atan2(F_z, F_y), in (−π, π]."),
    ("MB", "M_B", _MICRONEWTON_METRE, "bending moment", "hypot(M_y, M_z)."),
    ("MD", "M_D", _DEGREE, "direction of the bending moment", "atan2(M_z, M_y), in (−π, π]."),
    # What the solver and the estimator say
    (
        "residual",
        r"\varepsilon",
        _NUMBER,
        "residual",
        "By how much the load's equations are missed, in units of whisker length and stiffness.",
    ),
    ("status", r"\mathrm{status}", _NUMBER, "status", "What became of this row."),
    (
        "fold_determinant",
        r"\det J / \det J_0",
        _NUMBER,
        "distance from the fold",
        "Determinant of the load's Jacobian over its value at rest; the whisker slips off at zero.",
    ),
    (
        "point_jacobian",
        r"\partial\mathbf{p}/\partial\xi",
        _POINT_PER_LOAD,
        "derivatives of the contact point",
        "With respect to arc length and force (s_c, f_y, f_z) of the contact.",
    ),
    (
        "force_jacobian",
        r"\partial\mathbf{F}/\partial\xi",
        _FORCE_PER_LOAD,
        "derivatives of the force",
        "With respect to arc length and force (s_c, f_y, f_z) of the contact.",
    ),
    (
        "moment_jacobian",
        r"\partial\mathbf{M}/\partial\xi",
        _MOMENT_PER_LOAD,
        "derivatives of the moment",
        "With respect to arc length and force (s_c, f_y, f_z) of the contact.",
    ),
    ("covariance", r"\Sigma_p", _SQUARE_MM, "covariance of the contact point", "In x, y, z."),
    ("sigma_x", r"\sigma_x", _MM, "standard deviation of x", "Predicted from the sensor's noise."),
    ("sigma_y", r"\sigma_y", _MM, "standard deviation of y", "Predicted from the sensor's noise."),
    ("sigma_z", r"\sigma_z", _MM, "standard deviation of z", "Predicted from the sensor's noise."),
    (
        "predicted_error",
        r"\sigma_p",
        _MM,
        "predicted 3D error",
        "Root mean square distance from the truth, predicted from the sensor's noise.",
    ),
    ("error_r", r"\Delta r", _MM, "error of r", "Estimate minus truth."),
    (
        "error_theta",
        r"\Delta\theta",
        _DEGREE,
        "error of azimuth",
        "Estimate minus truth, in (−π, π].",
    ),
    ("error_phi", r"\Delta\varphi", _DEGREE, "error of elevation", "Estimate minus truth."),
    (
        "error_distance",
        r"|\Delta\mathbf{p}|",
        _MM,
        "3D error",
        "Distance of the estimated from the true contact point.",
    ),
    (
        "separation",
        r"d_\mathrm{c}",
        _MM,
        "distance of the farthest candidate",
        "From a contact to the farthest one that feels the same.",
    ),
    (
        "misfit",
        r"\chi",
        _NUMBER,
        "misfit",
        "Of three signals: how far they are from any that a contact explains, in shares of each "
        "signal's range; of more: χ², the sum of squares of what is left, in standard deviations.",
    ),
    (
        "linear",
        r"\mathrm{linear}",
        _NUMBER,
        "whether the covariance can be relied on",
        "1 where the contact scatters as the derivatives say, 0 where it does not.",
    ),
    (
        "probability",
        "P",
        _NUMBER,
        "posterior probability",
        "Of a contact among all that explain the signals as noise has them.",
    ),
    ("candidates", "n", _NUMBER, "number of candidates", "Contacts that explain the signals."),
    ("share", r"\mathrm{share}", _PERCENT, "share", "Of all rows."),
    ("confidence", "c", _NUMBER, "confidence", "From 0 (none) to 1."),
    # The recording: how the whisker is held, what it touches
    (
        "base_position",
        r"\mathbf{o}",
        _MM,
        "base of the whisker",
        "In the laboratory frame; x_lab = base_rotation @ x_whisker + base_position.",
    ),
    (
        "base_rotation",
        "R",
        _NUMBER,
        "orientation of the base",
        "Rotation from the whisker's to the laboratory frame.",
    ),
    ("base_azimuth", r"\theta_\mathrm{w}", _DEGREE, "azimuth of the base", "Emergence angle."),
    ("base_elevation", r"\varphi_\mathrm{w}", _DEGREE, "elevation of the base", "Emergence angle."),
    (
        "base_roll",
        r"\zeta_\mathrm{w}",
        _DEGREE,
        "roll of the base",
        "About the tangent at the base.",
    ),
    ("frame", "i", _NUMBER, "frame of each video", "Counted from its first frame, which is 0."),
    ("trace", r"\mathbf{u}", _PIXEL, "whisker in the image", "Column and row from the top left."),
    (
        "trace_sigma",
        r"\sigma_u",
        _PIXEL,
        "standard deviation of the trace",
        "Across the whisker.",
    ),
    (
        "trace_confidence",
        "c_u",
        _NUMBER,
        "confidence of the trace",
        "Per view, from 0 (lost) to 1.",
    ),
    (
        "trace_misfit",
        r"\chi_u",
        _NUMBER,
        "misfit of the trace",
        "Root mean square distance of the fitted whisker's images from the traces, in their "
        "standard deviations.",
    ),
    (
        "centerline_sigma",
        r"\sigma_r",
        _MM,
        "standard deviation of the centreline",
        "In x, y, z of the laboratory.",
    ),
    (
        "contact_covariance",
        r"\Sigma_c",
        _SQUARE_MM,
        "covariance of the contact point",
        "In x, y, z of the laboratory.",
    ),
    (
        "wrench_covariance",
        r"\Sigma_w",
        _WRENCH_SQUARED,
        "covariance of force and moment",
        "In Fx, Fy, Fz, Mx, My, Mz.",
    ),
    (
        "pose_covariance",
        r"\Sigma_o",
        _POSE_SQUARED,
        "covariance of the base's pose",
        "Of its position and of a small turn about the laboratory's axes.",
    ),
    (
        "pose_wrench_covariance",
        r"\Sigma_{ow}",
        _POSE_AND_WRENCH,
        "covariance of the base's pose with force and moment",
        "Of position and turn with Fx, Fy, Fz, Mx, My, Mz, where all come from the same images.",
    ),
    (
        "contact_normal",
        r"\mathbf{n}",
        _NUMBER,
        "normal of the surface at the contact",
        "Direction of the contact force without its part along the whisker; laboratory frame.",
    ),
    (
        "normal_covariance",
        r"\Sigma_n",
        _NUMBER,
        "covariance of the normal at the contact",
        "Of the unit vector, so that it is zero along it; laboratory frame.",
    ),
    (
        "point_normal_covariance",
        r"\Sigma_{pn}",
        _MM,
        "covariance of contact point and normal",
        "Both come from the same signals; laboratory frame.",
    ),
    (
        "deviation",
        "d",
        _MM,
        "deviation from the rest shape",
        "Root mean square distance of the whisker from its rest shape, put on it.",
    ),
    (
        "trace_visible",
        "v",
        _NUMBER,
        "whether the whisker shows in the image",
        "1 where nothing hides it and it is inside the frame, 0 elsewhere.",
    ),
    (
        "base_position_head",
        r"\mathbf{o}_\mathrm{b,h}",
        _MM,
        "position of the base on the head",
        "Where the whisker leaves the face, in the head's frame.",
    ),
    (
        "contact_difference",
        r"|\Delta\mathbf{p}|",
        _MICROMETRE,
        "difference of the contact points",
        "Distance of a contact point that was found otherwise from that of the rod.",
    ),
    (
        "head_rotation",
        r"R_\mathrm{h}",
        _NUMBER,
        "orientation of the head",
        "Rotation from the head's to the laboratory frame.",
    ),
    (
        "head_position",
        r"\mathbf{o}_\mathrm{h}",
        _MM,
        "position of the head",
        "Origin of the head's frame in the laboratory frame.",
    ),
    (
        "reading",
        "c",
        _NUMBER,
        "reading of the sensor's channel",
        "In the unit that the mixing gives it.",
    ),
    (
        "mixing",
        "A",
        _NUMBER,
        "what a channel reads of force and moment",
        "reading = mixing @ (Fx, Fy, Fz, Mx, My, Mz), in N and N m.",
    ),
    # The truth of a simulated contact
    (
        "contact_force",
        r"\mathbf{F}_\mathrm{c}",
        _MICRONEWTON,
        "force of the object on the whisker",
        "At the contact, laboratory frame; without inertia it is the force at the base.",
    ),
    (
        "contact_object",
        r"\mathrm{object}",
        _NUMBER,
        "object in contact",
        "Its number in the group objects; -1 for none.",
    ),
    (
        "surface_point",
        r"\mathbf{p}_\mathrm{o}",
        _MM,
        "contact point on the object",
        "On its undeformed surface, laboratory frame.",
    ),
    (
        "surface_normal",
        r"\mathbf{n}",
        _NUMBER,
        "surface normal at the contact",
        "Of the object, outward, laboratory frame.",
    ),
    (
        "sliding",
        r"\mathrm{sliding}",
        _NUMBER,
        "whether the contact slides",
        "1 where friction is at its limit (always, without friction), 0 where it sticks or there "
        "is no contact.",
    ),
    (
        "overlap",
        r"\delta_2",
        _MICROMETRE,
        "overlap elsewhere",
        "How far the whisker reaches into an object away from its one simulated contact; zero "
        "where all contacts are simulated.",
    ),
    (
        "second_contact",
        r"\mathrm{second}",
        _NUMBER,
        "whether it touches elsewhere too",
        "1 where there is more than one contact; without inertia only the first is simulated, and "
        "overlap tells how far off that is.",
    ),
    # Objects
    ("object_position", r"\mathbf{c}", _MM, "object's place", "A point of it, laboratory frame."),
    (
        "object_axis",
        r"\mathbf{a}",
        _NUMBER,
        "object's direction",
        "Axis or outward normal, a unit vector in the laboratory frame.",
    ),
    ("object_radius", "R", _MM, "object's radius", "Of its surface."),
    (
        "parameter_covariance",
        r"\Sigma",
        _PARAMETERS,
        "covariance of a fitted shape's parameters",
        "Of its place, direction and radius.",
    ),
    (
        "surface_distance",
        r"d",
        _MICROMETRE,
        "distance from the surface",
        "Signed distance of the whisker's surface from the object's at the contact, positive "
        "outside.",
    ),
    (
        "surface_distance_predicted",
        r"d",
        _MICROMETRE,
        "distance from the surface, drawn",
        "As it would be if the contact point erred by its covariance alone.",
    ),
    (
        "surface_grid_point",
        r"\mathbf{x}",
        _MM,
        "point of the fitted surface",
        "Of a grid over the part that was touched.",
    ),
    (
        "surface_sigma",
        r"\sigma_d",
        _MM,
        "uncertainty of the surface",
        "Standard deviation of its place across the surface.",
    ),
    (
        "support_point",
        r"\mathbf{x}",
        _MM,
        "place that a free surface is made from",
        "Mean of merged contacts.",
    ),
    (
        "support_value",
        r"g",
        _MICROMETRE,
        "deviation from the base shape",
        "What is added to its signed distance; negative where the surface is outside of it.",
    ),
    ("support_variance", r"\sigma_g^2", _SQUARE_MM, "variance of the deviation", "Of one place."),
    ("shape_amplitude", "a", _MM, "amplitude of the deviation", "Where nothing was touched."),
    ("shape_length", r"\ell", _MM, "length of the deviation", "Over which it changes."),
    ("inlier", r"\mathrm{inlier}", _NUMBER, "whether a contact is no outlier", "1 or 0."),
    (
        "chi_squared",
        r"\chi^2",
        _NUMBER,
        "squared miss of a contact",
        "By how much it misses the fitted shape, in standard deviations, squared; missing for "
        "contacts that were not used.",
    ),
    ("object_size", r"\mathbf{l}", _MM, "object's edges", "Lengths along its own axes."),
    (
        "object_rotation",
        r"R_\mathrm{o}",
        _NUMBER,
        "object's orientation",
        "Columns are its own axes in the laboratory frame.",
    ),
    ("object_edge_radius", r"R_\mathrm{e}", _MM, "radius of edges", "By which they are rounded."),
    ("object_stiffness", "k", _SPRING, "object's stiffness", "Force over indentation."),
    ("object_vertices", r"\mathbf{v}", _MM, "mesh's vertices", "Laboratory frame."),
    ("object_faces", "f", _NUMBER, "mesh's triangles", "Numbers of their vertices."),
    ("object_resolution", "h", _MM, "mesh's resolution", "Grid spacing of its signed distance."),
    (
        "object_distance",
        r"d_\mathrm{object}",
        _MM,
        "distance from the known object",
        "Of the whisker's surface at the estimated contact from it, positive outside.",
    ),
    ("axis_offset", r"\Delta\mathbf{c}", _MM, "offset of the axis", "Of a fitted object."),
    ("axis_tilt", r"\Delta\mathbf{a}", _DEGREE, "tilt of the axis", "Of a fitted object."),
    ("center_offset", r"\Delta\mathbf{c}", _MM, "offset of the centre", "Of a fitted object."),
    ("diameter_error", r"\Delta D", _MM, "error of the diameter", "Of a fitted object."),
    ("peg_position", r"\mathbf{c}", _MM, "peg position", "A point of its axis, laboratory frame."),
    ("peg_axis", r"\mathbf{a}", _NUMBER, "peg axis", "Unit vector, laboratory frame."),
    ("peg_radius", r"R_\mathrm{peg}", _MM, "peg radius", "Of its surface."),
    ("peg_diameter", r"D_\mathrm{peg}", _MM, "peg diameter", "Of its surface."),
)

QUANTITIES: Mapping[str, Quantity] = MappingProxyType(
    {
        name: Quantity(name, symbol, unit.unit, unit.display, unit.factor, long_name, description)
        for name, symbol, unit, long_name, description in _ROWS
    }
)
"""Every quantity by its name."""


def quantity(name: str) -> Quantity:
    """Look a quantity up.

    Parameters
    ----------
    name : str
        Its name.

    Returns
    -------
    Quantity
        Its row of the table.

    Raises
    ------
    ValueError
        Where the table has no such name; says which are close.
    """
    if name not in QUANTITIES:
        allowed = difflib.get_close_matches(name, QUANTITIES) or list(QUANTITIES)
        raise ValueError(f"{name!r} is no quantity; did you mean one of {', '.join(allowed)}?")
    return QUANTITIES[name]


def attributes(name: str) -> dict[str, str]:
    """Attributes that a dataset's variable of this name carries.

    Parameters
    ----------
    name : str
        A name of :data:`QUANTITIES`.

    Returns
    -------
    dict
        ``units`` (SI), ``long_name`` and ``description``.

    Examples
    --------
    >>> attributes("MB")
    {'units': 'N m', 'long_name': 'bending moment', 'description': 'hypot(M_y, M_z).'}
    """
    q = quantity(name)
    return {"units": q.unit, "long_name": q.long_name, "description": q.description}


def axis_label(name: str) -> str:
    """Label an axis or a column with symbol and display unit.

    Parameters
    ----------
    name : str
        A name of :data:`QUANTITIES`.

    Returns
    -------
    str
        In mathtext; without parentheses where the quantity has no unit.

    Examples
    --------
    >>> axis_label("Fx")
    '$F_x$ (µN)'
    """
    q = quantity(name)
    return f"${q.symbol}$ ({q.display_unit})" if q.display_unit else f"${q.symbol}$"


_LARGER = {"µN": "mN", "mN": "N", "µN·m": "mN·m", "mN·m": "N·m"}


def shown_unit(name: str, values: ArrayLike) -> tuple[float, str]:
    """Choose the unit in which values are read most easily.

    Parameters
    ----------
    name : str
        A name of :data:`QUANTITIES`.
    values : array_like, any shape
        In the quantity's SI unit; NaN is left out.

    Returns
    -------
    factor : float
        What they are multiplied with to be in that unit.
    unit : str
        The display unit or, of forces and moments far larger than a rat's, one that is larger.

    Examples
    --------
    >>> shown_unit("Fx", [-4.3, 0.2])
    (1000.0, 'mN')
    """
    known = quantity(name)
    factor, unit = known.display_factor, known.display_unit
    size = np.abs(np.asarray(values, dtype=np.float64))
    largest = float(np.max(size, initial=0.0, where=np.isfinite(size)))
    while unit in _LARGER and largest * factor >= 1e4:
        factor, unit = factor * 1e-3, _LARGER[unit]
    return float(f"{factor:.6g}"), unit


def to_display(name: str, values: ArrayLike) -> NDArray[np.float64]:
    """Convert SI values to the unit they are shown in.

    Parameters
    ----------
    name : str
        A name of :data:`QUANTITIES`.
    values : array_like, any shape
        In the quantity's SI unit.

    Returns
    -------
    ndarray, the shape of ``values``
        In its display unit.

    Examples
    --------
    >>> float(to_display("length", 0.04))
    40.0
    """
    return np.asarray(values, dtype=np.float64) * quantity(name).display_factor

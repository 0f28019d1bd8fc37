"""Table of all physical quantities: names, symbols, units and meanings.

The table is ``quantities.csv``, one row per quantity, from which the attributes of datasets, labels
of figures and headings of tables are taken. Values are in SI units (``unit``) everywhere; figures
and printed tables show ``value * display_factor`` in ``display_unit``. F is the force of the object
on the whisker and M = p × F its moment about the base, both in the whisker frame: base at the
origin, x along the tangent at the base, y toward the side to which the whisker curves. Names and
symbols are those of the paper (Huet, Emnett & Hartmann 2022, doi:10.1371/journal.pcbi.1007763); its
mN·mm is our µN·m.
"""

from __future__ import annotations

import csv
import difflib
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["QUANTITIES", "Quantity", "attributes", "axis_label", "quantity", "to_display"]
__dir__ = __all__.copy


@dataclass(frozen=True)
class Quantity:
    """One physical quantity.

    Parameters
    ----------
    name : str
        Name of the variable in datasets and of the column in tables.
    symbol : str
        Symbol in mathtext, without the dollar signs.
    unit : str
        SI unit of every stored value; ``"1"`` if dimensionless.
    display_unit : str
        Unit in figures and printed tables; empty if dimensionless.
    display_factor : float
        Factor from the stored value to that in ``display_unit``.
    long_name : str
        Short description, as in a legend.
    description : str
        Exact meaning: frame, sign, conventions.
    """

    name: str
    symbol: str
    unit: str
    display_unit: str
    display_factor: float
    long_name: str
    description: str


_SAME = {("pixel", "px"), ("1", "")}  # pairs of names of the same unit
# Factors from units of storage to units of display.
_FACTORS = {
    ("m", "mm"): 1e3,
    ("m", "µm"): 1e6,
    ("s", "ms"): 1e3,
    ("1/m", "1/mm"): 1e-3,
    ("Pa", "GPa"): 1e-9,
    ("N m^2", "nN·m²"): 1e9,
    ("N m/rad", "µN·m/rad"): 1e6,
    ("rad", "°"): 180.0 / math.pi,
    ("N", "µN"): 1e6,
    ("N m", "µN·m"): 1e6,
    ("m^2", "mm²"): 1e6,
    ("kg/m^3", "kg/m³"): 1.0,
    ("1", "%"): 100.0,
}


def _display_factor(unit: str, shown: str) -> float:
    """Factor from a unit to its display unit; raise a ValueError if it is unknown."""
    # Units of covariances are products, which are displayed with a dot.
    if unit.replace("N m", "N·m").replace("^2", "²") == shown or (unit, shown) in _SAME:
        return 1.0
    if (unit, shown) not in _FACTORS:
        raise ValueError(f"how a value in {unit!r} is shown in {shown!r} is not known")
    return _FACTORS[unit, shown]


def _table() -> dict[str, Quantity]:
    """Read the table next to this module."""
    text = Path(__file__).with_suffix(".csv").read_text(encoding="utf-8")
    rows = csv.DictReader(text.splitlines())
    return {
        row["name"]: Quantity(
            **row, display_factor=_display_factor(row["unit"], row["display_unit"])
        )
        for row in rows
    }


QUANTITIES: Mapping[str, Quantity] = MappingProxyType(_table())
"""All quantities by name."""


def quantity(name: str) -> Quantity:
    """Look up a quantity.

    Parameters
    ----------
    name : str
        Name of the quantity.

    Returns
    -------
    Quantity
        Row of the table for this name.

    Raises
    ------
    ValueError
        If the table has no such name; the message lists similar names.
    """
    if name not in QUANTITIES:
        allowed = difflib.get_close_matches(name, QUANTITIES) or list(QUANTITIES)
        raise ValueError(f"{name!r} is not a quantity; did you mean one of {', '.join(allowed)}?")
    return QUANTITIES[name]


def attributes(name: str) -> dict[str, str]:
    """Return the attributes of a dataset's variable of this name.

    Parameters
    ----------
    name : str
        Name in :data:`QUANTITIES`.

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


# Alternative names of units.
_UNITS = MappingProxyType(
    dict.fromkeys(("meter", "meters", "metre", "metres"), "m")
    | dict.fromkeys(("sec", "second", "seconds"), "s")
    | dict.fromkeys(("newton", "newtons"), "N")
    | dict.fromkeys(("radian", "radians"), "rad")
    | dict.fromkeys(("px", "pixels"), "pixel")
    | dict.fromkeys(("", "dimensionless"), "1")
)


def unit_fault(name: str, unit: object) -> str:
    """Describe the fault of a unit other than that of a quantity; empty if it is the same."""
    wanted = attributes(name.removeprefix("unfiltered_"))["units"]
    if _plain_unit(str(unit)) == _plain_unit(wanted):
        return ""
    return f"{name} is in {unit}; {wanted} is needed"


def _plain_unit(text: str) -> str:
    """Unit without separators between its parts, for comparison."""
    return re.sub(r"[\s·⋅*.^]", "", _UNITS.get(text.strip(), text))


def axis_label(name: str) -> str:
    """Return the label of an axis or a column, with symbol and display unit.

    Parameters
    ----------
    name : str
        Name in :data:`QUANTITIES`.

    Returns
    -------
    str
        Label in mathtext; without parentheses if the quantity is dimensionless.

    Examples
    --------
    >>> axis_label("Fx")
    '$F_x$ (µN)'
    """
    q = quantity(name)
    return f"${q.symbol}$ ({q.display_unit})" if q.display_unit else f"${q.symbol}$"


_LARGER = {"µN": "mN", "mN": "N", "µN·m": "mN·m", "mN·m": "N·m"}


def shown_unit(name: str, values: ArrayLike) -> tuple[float, str]:
    """Factor from SI units, and the most readable unit for given values."""
    known = quantity(name)
    factor, unit = known.display_factor, known.display_unit
    size = np.abs(np.asarray(values, dtype=np.float64))
    largest = float(np.max(size, initial=0.0, where=np.isfinite(size)))
    while unit in _LARGER and largest * factor >= 1e4:
        factor, unit = factor * 1e-3, _LARGER[unit]
    return float(f"{factor:.6g}"), unit


def to_display(name: str, values: ArrayLike) -> NDArray[np.float64]:
    """Convert SI values to the display unit.

    Parameters
    ----------
    name : str
        Name in :data:`QUANTITIES`.
    values : array_like, any shape
        Values in the quantity's SI unit.

    Returns
    -------
    ndarray, the shape of ``values``
        Values in the display unit.

    Examples
    --------
    >>> float(to_display("length", 0.04))
    40.0
    """
    return np.asarray(values, dtype=np.float64) * quantity(name).display_factor

"""Protocol of a whisker with the chart of its contacts: the part of a contact map estimates use."""

from __future__ import annotations

from typing import Protocol

from vibrissa.rod import SearchTree, StableSet
from vibrissa.whisker import Whisker


class ChartedWhisker(Protocol):
    """A :class:`~vibrissa.contacts.ContactMap`, as the modules below it require it."""

    @property
    def whisker(self) -> Whisker:
        """The whisker."""

    @property
    def chart(self) -> StableSet:
        """Chart of its stable contacts."""

    @property
    def steps(self) -> int:
        """Number of integration steps."""

    def tree(self, triplet: tuple[str, ...]) -> SearchTree:
        """Return the search tree of three signals."""

    def determines(self, using: str | tuple[str, ...]) -> bool:
        """Check whether signals determine contacts."""

    def sagged(self, gravity: tuple[float, float, float]) -> ChartedWhisker:
        """Map of a weightless whisker with the shape of this one under its weight."""

    def __hash__(self) -> int:
        """Hash by identity, so that results are cached per map."""


def need_map(contact_map: object) -> None:
    """Raise a ValueError for what is not a contact map, for example the whisker itself."""
    if not hasattr(contact_map, "chart"):
        raise ValueError(
            f"a ContactMap is needed, such as ContactMap.simulate(whisker); got {contact_map!r}"
        )

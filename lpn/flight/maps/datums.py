"""Old datums, whose transformation to WGS 84 is not exact: notes for maps on them."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

from lpn.core.files import printable

# Old datums by their WKT names, with the error in metres of EPSG's best transformation to WGS 84 without a national grid; 0 if
# there is none.
_DATUMS = {
    "North_American_Datum_1927": 20, "Ordnance_Survey_of_Great_Britain_1936": 2, "Deutsches_Hauptdreiecksnetz": 3,
    "System_of_the_Unified_Trigonometrical_Cadastral_Network": 6, "European_Datum_1950": 10, "Pulkovo_1942": 5,
    "Pulkovo_1942_58": 10, "Pulkovo_1942_83": 5, "Tokyo": 9, "Nouvelle_Triangulation_Francaise": 2,
    "Australian_Geodetic_Datum_1966": 5, "Australian_Geodetic_Datum_1984": 5, "New_Zealand_Geodetic_Datum_1949": 5,
    "Monte_Mario": 4, "South_American_Datum_1969": 10, "Provisional_South_American_Datum_1956": 20, "Cape": 15,
    "Corrego_Alegre_1970-72": 5, "Beijing_1954": 15, "Xian_1980": 0, "New_Beijing": 0,
}  # fmt: skip
# Variants of these datums with another prime meridian.
_MERIDIANS = re.compile("_(Ferro|Paris|Rome)$")


def datum_notes(sheets: Iterable[tuple[str, Any]]) -> list[str]:
    """Return a sentence for each old datum that sheets lie on.

    Args:
        sheets: the name and the rasterio CRS of each.
    """
    on: dict[tuple[str, int], list[str]] = {}
    for name, crs in sheets:
        if (found := _old_datum(crs.to_wkt())) is not None:
            on.setdefault(found, []).append(printable(name))
    return [_sentence(datum, metres, names) for (datum, metres), names in on.items()]


def _old_datum(wkt: str) -> tuple[str, int] | None:
    """Return the old datum of a CRS and its error in metres, see `_DATUMS`; None for other datums."""
    found = re.search(r'\bDATUM\["([^"]+)",SPHEROID\["([^"]+)"', wkt)
    if found is None:
        return None
    datum, ellipsoid = found.groups()
    metres = _DATUMS.get(_MERIDIANS.sub("", datum))
    if metres is not None:
        return datum, metres
    ellipsoid_alone = datum.startswith(("Unknown", "Not_specified")) and not ellipsoid.startswith(("GRS", "WGS"))
    return (datum, 0) if ellipsoid_alone and "TOWGS84[" not in wkt else None


def _sentence(datum: str, metres: int, names: list[str]) -> str:
    several = len(names) > 1
    lie = f"{len(names)} sheets, such as {names[0]}, lie" if several else f"{names[0]} lies"
    off = (
        f"some {metres} m, unless PROJ's grids of its country are installed"
        if metres
        else "more than 100 m, as no way from it to WGS 84 is known here"
    )
    return (
        f"{lie} on the datum {printable(datum.replace('_', ' '))}, and {'their' if several else 'its'} places may be off by "
        f"{off}. Deliver the map on WGS 84, or tell its --error."
    )

"""The buildings of a rendered city, from its plan `world.json`."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from explorer.screen.scene import shapes
from lpn.core.arrays import Float32Array, Int64Array
from lpn.core.errors import LPNError
from lpn.core.lists import read_json
from lpn.datasets import geo
from lpn.datasets.geo import Position
from lpn.datasets.rendered import PLAN

log = logging.getLogger(__name__)


def buildings(root: Path, origin: Position) -> tuple[Float32Array, Int64Array] | None:
    """Return vertices in metres east, north, and up, (V, 3), and triangles, (F, 3); None without a readable plan."""
    if not (root / PLAN).is_file():
        return None
    try:
        found = read_json(root / PLAN, PLAN)["buildings"]
        places = [Position(float(one["latitude"]), float(one["longitude"])) for one in found]
        shifts = geo.on_plane(places, origin) - np.array([(one["x"], one["y"]) for one in found], np.float64)
        outlines = [np.array(one["footprint"], np.float64) + shift for one, shift in zip(found, shifts, strict=True)]
        sizes = [[float(one[name]) for one in found] for name in ("ground", "height")]
        return shapes.extruded(outlines, *sizes)
    except (LPNError, KeyError, TypeError, ValueError, IndexError) as error:
        log.warning("The plan of the city cannot be drawn: %s", error)
        return None

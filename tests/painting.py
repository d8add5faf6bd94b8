"""Stands in for `lpn.world.render` where there is no Blender: pictures of noise, the same for the same camera."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TextIO

import numpy as np


class Scene:
    """Has the methods of the real one."""

    def __init__(self, *_: object) -> None:
        pass

    def frame(self, pose: Any, pixels: int) -> Any:
        """Light of a drone's picture."""
        return _light(pose, pixels, pixels)

    def panorama(self, panorama: Any, pixels: int) -> Any:
        """Light from all around."""
        width, height = panorama.size(pixels)
        return _light(panorama, height, width)

    def sweep(self, sweep: Any) -> Any:
        """Light of a satellite's picture."""
        return _light(sweep, sweep.pixels, sweep.pixels)

    def come_down(self) -> None:
        """Nothing is hidden from above."""


@contextmanager
def quiet() -> Iterator[TextIO]:
    """There are no reports to keep off the terminal."""
    yield sys.stdout


@contextmanager
def workplace() -> Iterator[Path]:
    """A folder of its own."""
    with TemporaryDirectory() as folder:
        yield Path(folder)


def _light(camera: Any, height: int, width: int) -> Any:
    seed = [int(abs(value) * 100) for value in (camera.x, camera.y)]
    return np.random.default_rng(seed).random((height, width, 3), np.float32)

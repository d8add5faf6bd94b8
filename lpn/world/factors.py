"""Factors that a varied world draws at random. The command line lists them, so this module imports nothing of the world."""

from __future__ import annotations

from typing import Literal, get_args

Factor = Literal["days", "cameras", "poses", "materials", "traffic", "construction", "snow", "plan"]
"""A property of a varied world.

days: two days from spring to late autumn for each district, one of the drone and one of the satellite.
cameras: exposure, colours, haze, blur, noise, and compression of each picture.
poses: height, tilt, lens, and ground of each drone picture.
materials: roofs, walls, and pavements of each district.
traffic: how full streets and car parks are on each day.
construction: buildings that do not stand on the satellite's day; never one that is photographed.
snow: some days have it.
plan: bends and slants of streets, and sizes of blocks in each district.
"""
FACTORS: tuple[Factor, ...] = get_args(Factor)

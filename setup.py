"""The packages, which pyproject.toml cannot list: those of the code, and each folder of `assets` as `lpn.assets.NAME`."""

from pathlib import Path

from setuptools import find_packages, setup

FOLDERS = {
    f"lpn.assets.{folder.name}": f"assets/{folder.name}"
    for folder in sorted(Path("assets").iterdir())
    if folder.is_dir() and folder.name != "__pycache__"
}

setup(packages=[*find_packages(include=["lpn*", "explorer*"]), *FOLDERS], package_dir=FOLDERS)
